// Averages the halves of a feature: skip path of the layer that merges them.
//
// Halves [rows, 2 * width] INPUT
// Out    [rows, width] f32
#version 460
#pragma element INPUT
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Halves { INPUT halves[]; };
layout(set = 0, binding = 1) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
};

void main() {
    uint i = global_index();
    if (i >= rows * width) return;
    uint at = i / width * 2 * width + i % width;
    result[i] = 0.5 * (from_INPUT(halves[at]) + from_INPUT(halves[at + width]));
}
