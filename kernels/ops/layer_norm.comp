// Normalizes rows: out = (x - mean) / sqrt(variance + eps) * weight + bias, x = source + addend.
//
// Source       [rows, width] f32; `leading` special tokens precede every `patches` rows
// Addend       [rows, width] f32; read if ADD
// Weight, Bias [width] f32
// Out          [rows, out_stride] OUTPUT, columns from out_column on, without special tokens
//
// One subgroup owns one row, a workgroup SUBGROUPS of them.
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

#include "shared/row_statistics.glsl"

layout(constant_id = 1) const bool ADD = false;
layout(constant_id = 2) const uint SUBGROUPS = 1;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Addend { float addend[]; };
layout(set = 0, binding = 2) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 3) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 4) writeonly buffer Out { OUTPUT result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
    uint out_stride;
    uint out_column;
    uint patches;
    uint leading;
    float eps;
};

uint from;
uint addend_from;

float value_of(uint c) { return ADD ? source[from + c] + addend[addend_from + c] : source[from + c]; }

void main() {
    uint row = group_index() * SUBGROUPS + gl_SubgroupID;
    if (row >= rows) return;
    from = (row + (row / patches + 1) * leading) * width;
    addend_from = row * width;
    Statistics statistics = row_statistics(width, eps);
    uint to = row * out_stride + out_column;
    for (uint c = gl_SubgroupInvocationID; c < width; c += gl_SubgroupSize) {
        result[to + c] = to_OUTPUT(normed(statistics, value_of(c)) * weight[c] + bias[c]);
    }
}
