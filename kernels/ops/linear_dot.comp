// Linear layer of 8-bit integers by packed dot products, bit-identical to ops/linear_matrix.
//
// A            [rows, inner] i8, inner a multiple of 8
// Weight       [columns, inner] i8, columns a multiple of 4 (SwiGLU: 8)
// RowScales    [rows] f32, scales of A
// ColumnScales [columns] f32, scales of Weight
// Bias, Gamma, Residual, Out as in ops/linear
//
// One workgroup owns TILE_ROWS x TILE_COLUMNS sums, a lane LANE_ROWS x LANE_COLUMNS, interleaved.
// Shared memory stages TILE_K terms while the next ones load.
#version 460
#pragma factor i8
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_integer_dot_product : require
#include "shared/epilogue.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 4) const uint SUBGROUPS = 1;
layout(constant_id = 5) const uint TILE_COLUMNS = 32;
layout(constant_id = 6) const uint LANE_ROWS = 4;
layout(constant_id = 7) const uint LANE_COLUMNS = 4; // a multiple of 4
layout(constant_id = 8) const uint TILE_K = 32;      // a multiple of 16

const uint LANES = gl_WorkGroupSize.x;
const uint LANE_QUADS = LANE_COLUMNS / 4;
const uint TILE_QUADS = TILE_COLUMNS / 4;
const uint COLUMN_LANES = TILE_COLUMNS / LANE_COLUMNS;
const uint ROW_LANES = LANES / COLUMN_LANES;
const uint TILE_ROWS = ROW_LANES * LANE_ROWS;
// Vectors of 8 terms, one of padding per row against bank conflicts.
const uint PIECES = TILE_K / 8;
const uint STRIDE = PIECES + 1;
const uint STAGED_A = TILE_ROWS * STRIDE;
const uint A_LOADS = (TILE_ROWS * PIECES + LANES - 1) / LANES;
const uint W_LOADS = (TILE_COLUMNS * PIECES + LANES - 1) / LANES;

layout(set = 0, binding = 0) readonly buffer A { ivec2 a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { ivec2 weight[]; };
layout(set = 0, binding = 6) readonly buffer RowScales { float row_scales[]; };
layout(set = 0, binding = 7) readonly buffer ColumnScales { vec4 column_scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
};

shared ivec2 staged[STAGED_A + TILE_COLUMNS * STRIDE];

ivec2 next_a[A_LOADS];
ivec2 next_weight[W_LOADS];

// Surplus rows and columns repeat the last; terms past `inner` are 0.
void load(uint first_row, uint first_column, uint first) {
    uint pieces = inner / 8;
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        uint k = first + at % PIECES;
        uint row = min(first_row + at / PIECES, rows - 1);
        next_a[i] = k < pieces ? a[row * pieces + k] : ivec2(0);
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        uint k = first + at % PIECES;
        uint column = min(first_column + at / PIECES, columns - 1);
        next_weight[i] = k < pieces ? weight[column * pieces + k] : ivec2(0);
    }
}

// Columns that neighboring lanes read together are adjacent.
uint staged_column(uint quad, uint c) { return STAGED_A + (c * TILE_QUADS + quad) * STRIDE; }

void stage() {
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        if (at < TILE_ROWS * PIECES) staged[at / PIECES * STRIDE + at % PIECES] = next_a[i];
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        uint column = at / PIECES;
        if (at < TILE_COLUMNS * PIECES) staged[staged_column(column / 4, column % 4) + at % PIECES] = next_weight[i];
    }
}

void main() {
    uint first_row = gl_WorkGroupID.y * TILE_ROWS;
    uint first_column = gl_WorkGroupID.x * TILE_COLUMNS;
    uint own_row = gl_LocalInvocationID.x / COLUMN_LANES;
    uint own_quad = gl_LocalInvocationID.x % COLUMN_LANES;

    ivec4 sum[LANE_ROWS][LANE_QUADS];
    [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
        [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) sum[r][q] = ivec4(0);
    }
    load(first_row, first_column, 0);
    stage();
    barrier();
    for (uint tile = 0; tile < inner; tile += TILE_K) {
        bool more = tile + TILE_K < inner;
        if (more) load(first_row, first_column, (tile + TILE_K) / 8);
        [[unroll]] for (uint k = 0; k < PIECES; k++) {
            ivec2 b[LANE_QUADS][4];
            [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) {
                [[unroll]] for (uint c = 0; c < 4; c++) {
                    b[q][c] = staged[staged_column(own_quad + q * COLUMN_LANES, c) + k];
                }
            }
            [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
                ivec2 x = staged[(own_row + r * ROW_LANES) * STRIDE + k];
                [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) {
                    [[unroll]] for (uint c = 0; c < 4; c++) {
                        sum[r][q][c] += dotPacked4x8EXT(x.x, b[q][c].x);
                        sum[r][q][c] += dotPacked4x8EXT(x.y, b[q][c].y);
                    }
                }
            }
        }
        barrier();
        if (more) stage();
        barrier();
    }

    [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) {
        uint quad = first_column / 4 + own_quad + q * COLUMN_LANES;
        if (4 * quad >= columns) continue;
        vec4 offset = bias_of(quad, columns);
        [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
            uint row = first_row + own_row + r * ROW_LANES;
            if (row >= rows) continue;
            finish(vec4(sum[r][q]) * (row_scales[row] * column_scales[quad]) + offset, row, quad, columns);
        }
    }
}
