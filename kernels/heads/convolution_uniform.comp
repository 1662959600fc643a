// Convolution of heads/convolution with uniform loads, for CPU drivers.
//
// Source   [lines, pitch] f32, lines from source_first on, with a zero border
// Weight   [panels, side, span, PANEL_COLUMNS] f32, the last panel padded; span = side * channels
// Bias     [columns] f32
// Residual [pixels, columns] f32; read if ADD
// Out      [pixels, columns] f32, pixels from `first` on
//
// The border makes the taps of a line contiguous, as in a linear layer. Otherwise as
// ops/linear_uniform, with pixels for rows.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/gelu.glsl"
#include "shared/limits.glsl"

layout(local_size_x_id = 0) in;

#include "shared/uniform.glsl"

layout(constant_id = 1) const bool GELU = false;
layout(constant_id = 2) const bool ADD = false;
layout(constant_id = 3) const uint TERMS = 4; // per loop pass; divides span
layout(constant_id = 4) const uint TILE_ROWS = 6;
layout(constant_id = 5) const uint VECTORS = 2; // VECTORS * subgroup size divides PANEL_COLUMNS
layout(constant_id = 6) const bool ADD_RECTIFIED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Residual { float residual[]; };
layout(set = 0, binding = 4) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint pixels;
    uint first;
    uint out_width;
    uint columns;
    uint side;
    uint step;
    uint channels;
    uint pitch;
    uint source_first;
    uvec2 source_address;
    uvec2 weight_address;
};

uint64_t row_at[TILE_ROWS];
float sum[TILE_ROWS][VECTORS];

// Adds term j at `offset` bytes of each pixel's line; `weights` addresses its weights.
void add_term(uint64_t offset, uint64_t weights, uint j) {
    float factor[VECTORS];
    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        factor[v] = vector_at(weights, j * PANEL_COLUMNS + v * gl_WorkGroupSize.x);
    }
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        float x = Values(row_at[r] + offset).values[j];
        [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] += x * factor[v];
    }
}

void main() {
    find_lanes();
    uint first_row = gl_WorkGroupID.x * TILE_ROWS;
    uint first_column = gl_WorkGroupID.y * VECTORS * gl_WorkGroupSize.x;
    uint span = side * channels;
    uint64_t weight_at = packUint2x32(weight_address)
        + 4 * (uint64_t(first_column / PANEL_COLUMNS * side * span) * PANEL_COLUMNS + first_column % PANEL_COLUMNS);
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        uint pixel = first + min(first_row + r, pixels - 1);
        uint x = pixel % out_width * step, y = pixel / out_width * step - source_first;
        row_at[r] = packUint2x32(source_address) + 4 * (uint64_t(y) * pitch + x * channels);
        [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] = 0.0;
    }
    uint line = 0;
    do {
        uint64_t line_at = 4 * uint64_t(line * pitch);
        uint64_t weights = weight_at + 4 * uint64_t(line * span) * PANEL_COLUMNS;
        uint k = 0;
        do {
            [[unroll]] for (uint j = 0; j < TERMS; j++) {
                add_term(line_at + 4 * uint64_t(k), weights + 4 * uint64_t(k) * PANEL_COLUMNS, j);
            }
            k += TERMS;
        } while (k < span);
        line++;
    } while (line < side);

    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        uint column = first_column + v * gl_WorkGroupSize.x + lane;
        float offset = column < columns ? bias[column] : 0.0;
        [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
            uint row = first_row + r;
            if (row >= pixels || column >= columns) continue;
            uint at = row * columns + column;
            float value = sum[r][v] + offset;
            if (GELU) value = gelu(value);
            if (ADD) value += ADD_RECTIFIED ? max(residual[at], 0.0) : residual[at];
            result[at] = value;
        }
    }
}
