// What the head's activations and their gradients agree on (paper, section 3.3).
#include "shared/lengths.glsl"

const float FARTHEST = 5;          // raw means are clamped to this, either way
const float SCALE_SHIFT = 4;       // that raw scales are less
const vec2 SCALES = vec2(1e-6, 15); // where scales are clamped
const float SHORTEST = 1e-12;      // quaternions that are shorter are divided by this

// Of length 1, where `quat` is not too short for that.
vec4 direction_of(vec4 quat) { return quat / largest_of(quat) / length(quat / largest_of(quat)); }
