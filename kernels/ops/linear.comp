// Linear layer with epilogue: out = residual + gamma * activation(a * weight + bias).
//
// A        [rows, inner] INPUT, inner a multiple of 4
// Weight   [panels, inner, PANEL_COLUMNS] INPUT, the last panel padded; read unless Q8
// Integers [panels, inner / 4, PANEL_COLUMNS / 4, 4, 4] i8, 4 terms of 4 columns; read if Q8
// Scales   [panels, inner / Q8_GROUP, PANEL_COLUMNS] f16; read if Q8
// Bias     [columns] f32
// Gamma    [columns] f32, LayerScale; read if SCALE
// Residual [rows, columns] f32, may alias Out; read if ADD
// Out      [rows, columns] OUTPUT, 16 bits saturate; [rows, columns / 2] after SwiGLU;
//          [parts, rows, columns] f32 partial sums for ops/linear_merge if SPLIT
//
// SwiGLU alternates gate and value columns. One subgroup owns ROWS rows, 4 columns a lane, and
// `share` terms if SPLIT (split-K). Addresses of A are uniform.
#version 460
#pragma element INPUT
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/epilogue.glsl"
#include "shared/limits.glsl"
#include "shared/q8.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 4) const bool Q8 = false;
layout(constant_id = 5) const bool SPLIT = false;

const uint ROWS = LINEAR_ROWS;

layout(set = 0, binding = 0) readonly buffer A { INPUT4 a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { INPUT4 weight[]; };
layout(set = 0, binding = 6) readonly buffer Integers { uvec4 integers[]; };
layout(set = 0, binding = 7) readonly buffer Scales { uvec2 scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
    uint share;
};

void main() {
    uint quad = gl_WorkGroupID.y * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint first_row = gl_WorkGroupID.x * ROWS;
    uint quads = (columns + 3) / 4;
    uint quads_inner = inner / 4;
    const uint panel_quads = PANEL_COLUMNS / 4;
    // Surplus lanes keep the loop uniform.
    uint panel = min(quad, quads - 1) / panel_quads;
    uint weight_at = panel * inner * panel_quads + quad % panel_quads;
    uint integers_at = panel * quads_inner * panel_quads + quad % panel_quads;
    uint scales_at = panel * (inner / Q8_GROUP) * panel_quads + quad % panel_quads;

    vec4 sum[ROWS];
    uint row_at[ROWS];
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        sum[r] = vec4(0.0);
        row_at[r] = min(first_row + r, rows - 1) * quads_inner;
    }
    uint first = SPLIT ? gl_WorkGroupID.z * share / 4 : 0;
    uint end = SPLIT ? min(first + share / 4, quads_inner) : quads_inner;
    for (uint k = first; k < end; k++) {
        vec4 b0, b1, b2, b3;
        if (Q8) {
            vec4 scale = q8_scales(scales[scales_at + k / (Q8_GROUP / 4) * panel_quads]);
            uvec4 quads = integers[integers_at + k * panel_quads];
            b0 = q8_integers(quads.x) * scale;
            b1 = q8_integers(quads.y) * scale;
            b2 = q8_integers(quads.z) * scale;
            b3 = q8_integers(quads.w) * scale;
        } else {
            uint at = weight_at + 4 * k * panel_quads;
            b0 = from_INPUT4(weight[at]);
            b1 = from_INPUT4(weight[at + panel_quads]);
            b2 = from_INPUT4(weight[at + 2 * panel_quads]);
            b3 = from_INPUT4(weight[at + 3 * panel_quads]);
        }
        [[unroll]] for (uint r = 0; r < ROWS; r++) {
            vec4 x = from_INPUT4(a[row_at[r] + k]);
            sum[r] += x.x * b0;
            sum[r] += x.y * b1;
            sum[r] += x.z * b2;
            sum[r] += x.w * b3;
        }
    }

    if (quad >= quads) return;
    vec4 offset = SPLIT ? vec4(0.0) : bias_of(quad, columns);
    uint above = SPLIT ? gl_WorkGroupID.z * rows : 0;
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        uint row = first_row + r;
        if (row < rows) finish(sum[r] + offset, above + row, quad, columns);
    }
}
