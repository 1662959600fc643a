// Lays out the inputs of a convolution as rows of a matrix product, one row for every pixel of the result.
//
// Source    [lines, width, channels] f32, lines source_first on of a picture of `height` lines
// Gate      [lines, width, channels] f32, likewise; read where GATED
// Out       [rows, row] f32, pixels first on of a picture with out_width pixels a line; a row is
//           [side, side, channels] and zeros behind
//
// The picture is 0 outside. Where spread > 1, spread - 1 zeros lie between its pixels (a transposed convolution).
// RECTIFIED values are at least 0; GATED ones are 0 where their gate is not above 0.
// One invocation an element.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool RECTIFIED = false;
layout(constant_id = 2) const bool GATED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Gate { float gate[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count; // rows * row
    uint row;
    uint first;
    uint out_width;
    uint channels;
    uint width;
    uint height;
    uint source_first;
    uint side;
    uint step;
    uint padding;
    uint spread;
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint pixel = first + i / row, tap = i % row / channels;
    uvec2 out_at = uvec2(pixel % out_width, pixel / out_width);
    ivec2 spread_at = ivec2(out_at * step + uvec2(tap % side, tap / side)) - int(padding);
    uvec2 at = uvec2(max(spread_at, ivec2(0))) / spread;
    bool inside = all(greaterThanEqual(spread_at, ivec2(0))) && all(lessThan(at, uvec2(width, height)));
    float value = 0;
    if (inside && tap < side * side && at * spread == uvec2(spread_at)) {
        uint from = ((at.y - source_first) * width + at.x) * channels + i % row % channels;
        value = source[from];
        if (RECTIFIED) value = max(value, 0);
        if (GATED && !(gate[from] > 0)) value = 0;
    }
    result[i] = value;
}
