// Lays out convolution inputs as rows of a matrix product, one row per output pixel.
//
// Source [lines, width, channels] f32, lines from source_first on; 0 outside the image
// Gate   [lines, width, channels] f32, as Source; read if GATED
// Out    [rows, row] f32, pixels from `first` on; a row is [side, side, channels] and padding
//
// SPREAD - 1 zeros separate the pixels (transposed convolution). RECTIFIED clamps values to 0 and
// above. GATED keeps values with a positive gate. One subgroup owns one row, which keeps divisions
// out of the loop.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const bool RECTIFIED = false;
layout(constant_id = 2) const bool GATED = false;
layout(constant_id = 3) const uint SPREAD = 1;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Gate { float gate[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint rows;
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
};

void main() {
    uint row_index = group_index();
    if (row_index >= rows) return;
    uint pixel = first + row_index, begin = row_index * row, lane = gl_LocalInvocationID.x;
    ivec2 corner = ivec2(uvec2(pixel % out_width, pixel / out_width) * step) - int(padding);
    uvec2 tap_at = uvec2(0);
    for (uint tap = 0; tap < side * side; tap++) {
        ivec2 spread_at = corner + ivec2(tap_at);
        tap_at = tap_at.x + 1 < side ? tap_at + uvec2(1, 0) : uvec2(0, tap_at.y + 1);
        uvec2 at = uvec2(max(spread_at, ivec2(0))) / SPREAD;
        bool inside = all(greaterThanEqual(spread_at, ivec2(0))) && all(lessThan(at, uvec2(width, height)))
            && at * SPREAD == uvec2(spread_at);
        uint from = inside ? ((at.y - source_first) * width + at.x) * channels : 0;
        for (uint c = lane; c < channels; c += gl_WorkGroupSize.x) {
            float value = inside ? source[from + c] : 0;
            if (RECTIFIED) value = max(value, 0);
            if (GATED) value = inside && gate[from + c] > 0 ? value : 0;
            result[begin + tap * channels + c] = value;
        }
    }
    for (uint i = side * side * channels + lane; i < row; i += gl_WorkGroupSize.x) result[begin + i] = 0;
}
