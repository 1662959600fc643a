// Sums the split-K parts of a linear layer in order and applies its epilogue.
//
// Sums [parts, rows, columns] f32
// Bias, Gamma, Residual, Out as in ops/linear
//
// One invocation owns 4 columns of a row.
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/epilogue.glsl"
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(set = 0, binding = 0) readonly buffer Sums { float sums[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint columns;
    uint parts;
};

void main() {
    uint quads = (columns + 3) / 4;
    uint row = global_index() / quads;
    uint quad = global_index() % quads;
    if (row >= rows) return;
    vec4 sum = vec4(0.0);
    for (uint p = 0; p < parts; p++) {
        uint at = (p * rows + row) * columns + 4 * quad;
        [[unroll]] for (uint c = 0; c < 4; c++) sum[c] += 4 * quad + c < columns ? sums[at + c] : 0.0;
    }
    finish(sum + bias_of(quad, columns), row, quad, columns);
}
