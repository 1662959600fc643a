// Computes means and variances along image rows, for SSIM.
//
// Frames  [rows, width, channels] f32: a, RGB first, 0 outside
// Targets [rows, width, 3] f32: b, 0 outside
// Moments [rows, width, 3, 4] f32: mean a, mean a - b, var a + var b, var (a - b)
//
// One invocation owns RUN pixels of a row in one color.
// Source: SSIM (Wang et al. 2004).
#version 460
#extension GL_EXT_control_flow_attributes : require
layout(local_size_x = 64) in;
layout(constant_id = 1) const uint RUN = 8;
#include "shared/index.glsl"
#include "shared/moments.glsl"
#include "shared/window.glsl"

layout(set = 0, binding = 0) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(set = 0, binding = 2) writeonly buffer Moments { vec4 moments[]; };
layout(push_constant) uniform Push { uint rows; uint width; uint channels; };

vec4 moments_of(uint pixel, uint color) {
    float a = frames[pixel * channels + color];
    return vec4(a, a - targets[pixel * 3 + color], 0, 0);
}

void main() {
    uint runs = (width + RUN - 1) / RUN;
    uint color = global_index() % 3, run = global_index() / 3 % runs, row = global_index() / (3 * runs);
    if (row >= rows) return;
    vec2 center = moments_of(row * width + min(run * RUN + RUN / 2, width - 1), color).xy;
    vec4 filtered[RUN];
    [[unroll]] for (uint p = 0; p < RUN; p++) filtered[p] = vec4(0);
    [[unroll]] for (int k = 0; k < REACH; k++) {
        int x = int(run * RUN) + k - RADIUS;
        vec4 value = moments_of(row * width + clamp(x, 0, int(width) - 1), color);
        add_tap(filtered, k, squared(x >= 0 && x < width ? value : vec4(0), center));
    }
    [[unroll]] for (uint p = 0; p < RUN; p++) {
        uint x = run * RUN + p;
        if (x < width) moments[(row * width + x) * 3 + color] = centered(filtered[p], center);
    }
}
