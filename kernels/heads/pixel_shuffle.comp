// Pixel shuffle, the last step of a transposed convolution without kernel overlap.
//
// Source [height, width, side, side, channels] f32, any range of lines
// Bias   [channels] f32
// Out    [height * side, width * side, channels] f32, the same lines: source + bias
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count;
    uint width;
    uint side;
    uint channels;
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint channel = i % channels, pixel = i / channels;
    uvec2 at = uvec2(pixel % (width * side), pixel / (width * side));
    uvec2 from = at / side, tap = at % side;
    uint value = (((from.y * width + from.x) * side + tap.y) * side + tap.x) * channels + channel;
    result[i] = source[value] + bias[channel];
}
