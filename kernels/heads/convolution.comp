// Convolves an image: out = residual + activation(bias + sum of source * weight).
//
// Source   [lines, width, channels] f32, lines from source_first on of `height`, 0 outside;
//          channels a multiple of 4
// Weight   [panels, side * side * channels, PANEL_COLUMNS] f32, the last panel padded
// Bias     [columns] f32
// Residual [pixels, columns] f32; read if ADD
// Out      [pixels, columns] f32, pixels from `first` on
//
// RECTIFIED clamps source values to 0 and above, ADD_RECTIFIED the residual. One subgroup owns ROWS
// pixels and 4 columns a lane. Addresses of Source are uniform, as in ops/linear.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/gelu.glsl"
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const bool RECTIFIED = false;
layout(constant_id = 2) const bool GELU = false;
layout(constant_id = 3) const bool ADD = false;
layout(constant_id = 4) const bool ADD_RECTIFIED = false;

const uint ROWS = LINEAR_ROWS;

layout(set = 0, binding = 0) readonly buffer Source { vec4 source[]; };
layout(set = 0, binding = 1) readonly buffer Weight { vec4 weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Residual { float residual[]; };
layout(set = 0, binding = 4) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint pixels;
    uint first;
    uint out_width;
    uint columns;
    uint channels;
    uint width;
    uint height;
    uint source_first;
    uint side;
    uint step;
    uint padding;
};

void main() {
    uint across = (columns + 4 * gl_WorkGroupSize.x - 1) / (4 * gl_WorkGroupSize.x);
    uint first_row = group_index() / across * ROWS;
    if (first_row >= pixels) return;
    uint quad = group_index() % across * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint quads = (columns + 3) / 4;
    uint channel_quads = channels / 4;
    const uint panel_quads = PANEL_COLUMNS / 4;
    // Surplus lanes keep the loop uniform.
    uint panel = min(quad, quads - 1) / panel_quads;
    uint weight_at = panel * side * side * channels * panel_quads + quad % panel_quads;

    vec4 sum[ROWS];
    ivec2 corner[ROWS];
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        uint pixel = first + min(first_row + r, pixels - 1);
        sum[r] = vec4(0.0);
        corner[r] = ivec2(uvec2(pixel % out_width, pixel / out_width) * step) - int(padding);
    }
    for (uint tap = 0; tap < side * side; tap++) {
        uint row_at[ROWS];
        bool inside[ROWS];
        [[unroll]] for (uint r = 0; r < ROWS; r++) {
            ivec2 at = corner[r] + ivec2(tap % side, tap / side);
            inside[r] = all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, ivec2(width, height)));
            row_at[r] = inside[r] ? ((uint(at.y) - source_first) * width + uint(at.x)) * channel_quads : 0;
        }
        for (uint k = 0; k < channel_quads; k++) {
            vec4 b0 = weight[weight_at];
            vec4 b1 = weight[weight_at + panel_quads];
            vec4 b2 = weight[weight_at + 2 * panel_quads];
            vec4 b3 = weight[weight_at + 3 * panel_quads];
            weight_at += 4 * panel_quads;
            [[unroll]] for (uint r = 0; r < ROWS; r++) {
                vec4 x = source[row_at[r] + k];
                if (RECTIFIED) x = max(x, vec4(0.0));
                x = inside[r] ? x : vec4(0.0);
                sum[r] += x.x * b0;
                sum[r] += x.y * b1;
                sum[r] += x.z * b2;
                sum[r] += x.w * b3;
            }
        }
    }

    if (quad >= quads) return;
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        uint row = first_row + r;
        if (row >= pixels) continue;
        [[unroll]] for (uint c = 0; c < 4; c++) {
            uint column = 4 * quad + c;
            if (column >= columns) continue;
            float value = sum[r][c] + bias[column];
            if (GELU) value = gelu(value);
            if (ADD) value += ADD_RECTIFIED ? max(residual[row * columns + column], 0.0) : residual[row * columns + column];
            result[row * columns + column] = value;
        }
    }
}
