// Backward pass of lpips/pool, to the first largest value of each window in row order.
//
// Source  [lines, width, channels] f32, lines from source_first on
// DOut    [lines, out_width, channels] f32, lines from out_first on of out_height
// DSource [lines, width, channels] f32, lines from `first` on
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer DOut { float d_out[]; };
layout(set = 0, binding = 2) writeonly buffer DSource { float d_source[]; };

layout(push_constant) uniform Push {
    uint count;
    uint first;
    uint out_first;
    uint out_width;
    uint out_height;
    uint channels;
    uint width;
    uint source_first;
    uint side;
    uint step;
};

float value_at(uvec2 at, uint channel) {
    return max(source[((at.y - source_first) * width + at.x) * channels + channel], 0);
}

// Whether the window at `corner` has its first largest value at `at`.
bool is_first_largest(uvec2 corner, uvec2 at, uint channel) {
    float value = value_at(at, channel);
    uvec2 place = at - corner;
    for (uint tap = 0; tap < side * side; tap++) {
        float other = value_at(corner + uvec2(tap % side, tap / side), channel);
        if (other > value || (other == value && tap < place.y * side + place.x)) return false;
    }
    return true;
}

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint pixel = i / channels, channel = i % channels;
    uvec2 at = uvec2(pixel % width, first + pixel / width);
    uvec2 begin = (max(at, uvec2(side - 1)) - (side - 1) + step - 1) / step;
    uvec2 end = min(at / step + 1, uvec2(out_width, out_height));
    float sum = 0;
    for (uint y = begin.y; y < end.y; y++) {
        for (uint x = begin.x; x < end.x; x++) {
            if (is_first_largest(uvec2(x, y) * step, at, channel)) {
                sum += d_out[((y - out_first) * out_width + x) * channels + channel];
            }
        }
    }
    d_source[i] = sum;
}
