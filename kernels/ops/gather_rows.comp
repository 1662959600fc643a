// Copies rows by index: out[i] = source[rows_from_out[i]].
//
// Source      [source_rows, width] f32, rows from first_row on of a longer array
// RowsFromOut [count] u32, row indices into the longer array
// Out         [count, width] f32
//
// Rows outside this part belong to other dispatches.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer RowsFromOut { uint rows_from_out[]; };
layout(set = 0, binding = 2) buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count;
    uint width;
    uint first_row;
    uint source_rows;
};

void main() {
    uint i = global_index();
    if (i >= count * width) return;
    uint row = rows_from_out[i / width] - first_row;
    if (row < source_rows) result[i] = source[row * width + i % width];
}
