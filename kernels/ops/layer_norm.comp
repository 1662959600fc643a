// Layer normalisation of rows: out = (x - mean) / sqrt(variance + eps) * weight + bias, x = source (+ addend).
//
// Source    [rows, width] f32
// Addend    [rows, width] f32, packed; read where ADD
// Weight    [width] f32
// Bias      [width] f32
// Out       [rows, out_stride] OUTPUT, columns from out_column on
//
// One workgroup (a subgroup) owns a row. The variance takes a second pass, as a difference of sums would cancel; that pass
// also finds what rounding left in the mean (corrected two-pass algorithm: Chan, Golub and LeVeque 1983), which is more than
// the spread where the mean is far above it.
// With `patches` > 0 the source has one more row (a camera token) before every `patches` rows, which is left out.
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"
#include "shared/norm_unit.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const bool ADD = false;

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
    float eps;
};

float load(uint from, uint packed_row, uint c) {
    float x = source[from + c];
    return ADD ? x + addend[packed_row * width + c] : x;
}

void main() {
    uint row = group_index();
    if (row >= rows) return;
    uint source_row = patches > 0 ? row + row / patches + 1 : row;
    uint from = source_row * width;

    float sum = 0.0;
    float largest = 0.0;
    for (uint c = gl_LocalInvocationID.x; c < width; c += gl_WorkGroupSize.x) {
        float x = load(from, row, c);
        sum += x;
        largest = max(largest, abs(x));
    }
    float mean = subgroupAdd(sum) / float(width);
    float unit = norm_unit(subgroupMax(largest));
    vec2 sums = vec2(0.0); // of differences and of their squares
    for (uint c = gl_LocalInvocationID.x; c < width; c += gl_WorkGroupSize.x) {
        float d = (load(from, row, c) - mean) * unit;
        sums += vec2(d, d * d);
    }
    sums = subgroupAdd(sums) / float(width);
    float scale = 1.0 / sqrt(max(sums.y - sums.x * sums.x, 0.0) + norm_epsilon(eps, unit));
    uint to = row * out_stride + out_column;
    for (uint c = gl_LocalInvocationID.x; c < width; c += gl_WorkGroupSize.x) {
        result[to + c] = to_OUTPUT(((load(from, row, c) - mean) * unit - sums.x) * scale * weight[c] + bias[c]);
    }
}
