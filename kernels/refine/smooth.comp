// Raises scales to the least scale that cameras resolve.
//
// Scales      [count, 3] f32, positive
// Opacities   [count] f32, scaled by the ratio of the volumes if COMPENSATED
// LeastScales [count] f32, of refine/least_scales
//
// One invocation owns one Gaussian.
#version 460
layout(local_size_x = 64) in;
layout(constant_id = 1) const bool COMPENSATED = false;
#include "shared/index.glsl"

layout(set = 0, binding = 0) buffer Scales { float scales[]; };
layout(set = 0, binding = 1) buffer Opacities { float opacities[]; };
layout(set = 0, binding = 2) readonly buffer LeastScales { float least_scales[]; };
layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = global_index();
    if (i >= count) return;
    float least = least_scales[i], ratio = 1;
    for (uint k = 0; k < 3; k++) {
        float scale = scales[3 * i + k];
        if (scale >= least) continue;
        ratio *= scale / least;
        scales[3 * i + k] = least;
    }
    if (COMPENSATED) opacities[i] *= ratio;
}
