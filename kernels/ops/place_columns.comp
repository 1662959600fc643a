// Copies rows of an array into columns of a wider one, to join arrays side by side.
//
// Source [groups, group, width] f32, rows `first` to `first + kept` of each group are copied
// Out    [rows, out_width] OUTPUT, columns from out_column on
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { OUTPUT result[]; };

layout(push_constant) uniform Push {
    uint count; // rows * width
    uint width;
    uint out_width;
    uint out_column;
    uint first;
    uint kept;
    uint group;
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint row = i / width;
    uint from = row / kept * group + first + row % kept;
    result[row * out_width + out_column + i % width] = to_OUTPUT(source[from * width + i % width]);
}
