// Filters the derivatives of loss/dssim along rows.
//
// Partials, Out [rows, width, 3, 3] f32, 0 outside
//
// One invocation owns RUN pixels of a row in one color.
#version 460
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
layout(constant_id = 1) const uint RUN = 8;
#include "shared/index.glsl"
#include "shared/window.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer Partials { vec3 partials[]; };
layout(scalar, set = 0, binding = 1) writeonly buffer Out { vec3 result[]; };
layout(push_constant) uniform Push { uint rows; uint width; };

void main() {
    uint runs = (width + RUN - 1) / RUN;
    uint color = global_index() % 3, run = global_index() / 3 % runs, row = global_index() / (3 * runs);
    if (row >= rows) return;
    vec4 filtered[RUN];
    [[unroll]] for (uint p = 0; p < RUN; p++) filtered[p] = vec4(0);
    [[unroll]] for (int k = 0; k < REACH; k++) {
        int x = int(run * RUN) + k - RADIUS;
        vec3 value = partials[(row * width + clamp(x, 0, int(width) - 1)) * 3 + color];
        add_tap(filtered, k, vec4(x >= 0 && x < width ? value : vec3(0), 0));
    }
    [[unroll]] for (uint p = 0; p < RUN; p++) {
        uint x = run * RUN + p;
        if (x < width) result[(row * width + x) * 3 + color] = filtered[p].xyz;
    }
}
