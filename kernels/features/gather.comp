// Adds the sums of features/lift over the tiles of a row's Gaussians.
//
// Slots, Status as in render/color_backward, of one camera
// Sums       [capacity, vectors, 4] f32, of features/lift
// Totals     [capacity] f32, of features/lift
// Lifted     [rows, vectors, 4] f32, accumulated; a row belongs to `group` consecutive Gaussians
// RowTotals  [rows] f32, accumulated
//
// One invocation owns one vector of one row; sums are in the order of Gaussians, then tiles.
// Nothing is added if intersections exceeded their capacity.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 1) readonly buffer Status { uint status[]; };
layout(set = 0, binding = 2) readonly buffer Sums { vec4 sums[]; };
layout(set = 0, binding = 3) readonly buffer Totals { float totals[]; };
layout(set = 0, binding = 4) buffer Lifted { vec4 lifted[]; };
layout(set = 0, binding = 5) buffer RowTotals { float row_totals[]; };
layout(push_constant) uniform Push { uint gaussians; uint group; uint rows; uint vectors; };

void main() {
    uint i = global_index();
    if (i >= rows * vectors || status[0] != status[1] || status[2] != 0) return;
    uint row = i / vectors, vector = i % vectors;
    uint end = slots[min((row + 1) * group, gaussians)];
    vec4 sum = vec4(0);
    float total = 0;
    for (uint slot = slots[row * group]; slot < end; slot++) {
        sum += sums[slot * vectors + vector];
        if (vector == 0) total += totals[slot];
    }
    lifted[i] += sum;
    if (vector == 0) row_totals[row] += total;
}
