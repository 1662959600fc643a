// Modulates rows by another token (adaptive layer norm):
// out = x + gate * (norm(x) * (1 + scale) + shift), norm without weights.
//
// Source     [rows, width] f32
// Modulation [rows, 3 * width] f32: shift, scale, gate
// Out        [rows, width] f32
//
// One subgroup owns one row.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

#include "shared/row_statistics.glsl"

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Modulation { float modulation[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
    float eps;
};

uint from;

float value_of(uint c) { return source[from + c]; }

void main() {
    uint row = group_index();
    if (row >= rows) return;
    from = row * width;
    Statistics statistics = row_statistics(width, eps);
    for (uint c = gl_SubgroupInvocationID; c < width; c += gl_SubgroupSize) {
        uint at = 3 * from + c;
        float x = value_of(c);
        float moved = normed(statistics, x) * (1.0 + modulation[at + width]) + modulation[at];
        result[from + c] = x + modulation[at + 2 * width] * moved;
    }
}
