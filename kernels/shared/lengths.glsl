// Lengths of nonzero vectors. Dividing by the largest component avoids overflow and underflow.

float largest_of(vec3 v) { return max(max(abs(v.x), abs(v.y)), abs(v.z)); }
float largest_of(vec4 v) { return max(max(abs(v.x), abs(v.y)), max(abs(v.z), abs(v.w))); }

vec3 unit_vector(vec3 v) { return normalize(v / largest_of(v)); }
vec4 unit_vector(vec4 v) { return normalize(v / largest_of(v)); }

float length_of(vec4 v) { return length(v / largest_of(v)) * largest_of(v); }
