// Bounds of the head's activations and their gradients (paper, section 3.3).
#include "shared/lengths.glsl"

const float FARTHEST = 5;          // clamp of raw means
const float SCALE_SHIFT = 4;       // subtracted from raw scales
const vec2 SCALES = vec2(1e-6, 15); // clamp of scales
const float SHORTEST = 1e-12;      // least divisor of quaternions

// Unit quaternion; `quat` has at least length SHORTEST.
vec4 direction_of(vec4 quat) { return quat / largest_of(quat) / length(quat / largest_of(quat)); }
