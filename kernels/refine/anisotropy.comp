// Steps each Gaussian's largest scale down to `ratio` times its middle one.
//
// Scales   [count, 3] f32, positive
// Schedule [4] f32, as in adam.comp: its rate scales `rate`
//
// One invocation owns one Gaussian.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) buffer Scales { float scales[]; };
layout(set = 0, binding = 1) readonly buffer Schedule { float schedule[]; };
layout(push_constant) uniform Push {
    uint count;
    float ratio, rate; // rate in ln scale
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    vec3 s = vec3(scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]);
    float middle = max(min(s.x, s.y), min(max(s.x, s.y), s.z));
    float largest = max(max(s.x, s.y), s.z);
    float limit = max(ratio * middle, largest * exp(-rate * schedule[0]));
    for (uint k = 0; k < 3; k++) scales[3 * i + k] = min(s[k], limit);
}
