// Max pooling of rectified features, without padding.
//
// Source [lines, width, channels] f32, lines from source_first on
// Out    [lines, out_width, channels] f32, lines from `first` on
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count;
    uint first;
    uint out_width;
    uint channels;
    uint width;
    uint source_first;
    uint side;
    uint step;
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint pixel = i / channels;
    uvec2 from = uvec2(pixel % out_width, first + pixel / out_width) * step;
    float largest = 0;
    for (uint tap = 0; tap < side * side; tap++) {
        uvec2 at = from + uvec2(tap % side, tap / side);
        largest = max(largest, source[((at.y - source_first) * width + at.x) * channels + i % channels]);
    }
    result[i] = largest;
}
