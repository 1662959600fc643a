// Linear layer of ops/linear on matrix units.
//
// A            [rows, inner] FACTOR, inner a multiple of 8
// Weight       [columns, inner] FACTOR, columns a multiple of 4 (SwiGLU: 8); read unless Q8
// Integers     [columns, inner] i8, expanded to FACTOR; read if Q8
// Scales       [columns, inner / Q8_GROUP] f16; read if Q8
// RowScales    [rows] f32, scales of A; read if FACTOR is i8
// ColumnScales [columns] f32, scales of Weight; read if FACTOR is i8
// Bias, Gamma, Residual, Out as in ops/linear
//
// One workgroup owns TILE_M x TILE_N sums, and `share` terms if SPLIT, a multiple of TILE_K; a
// subgroup REPEAT_M x REPEAT_N matrices. Shared memory stages TILE_K terms.
#version 460
#pragma factor f16 bf16 i8
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#include "shared/matrices.glsl"
#include "shared/gelu.glsl"
#include "shared/limits.glsl"
#include "shared/q8.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 5) const uint SUBGROUPS_N = 2; // along the columns
layout(constant_id = 6) const uint REPEAT_M = 4;    // matrices of a subgroup
layout(constant_id = 7) const uint REPEAT_N = 4;
layout(constant_id = 8) const uint TILE_K = 32;
layout(constant_id = 9) const uint ACTIVATION = 0; // 0 none, 1 GELU (erf), 2 SwiGLU
layout(constant_id = 10) const bool SCALE = false;
layout(constant_id = 11) const bool ADD = false;
layout(constant_id = 12) const bool Q8 = false; // not with i8 FACTOR
layout(constant_id = 13) const bool SPLIT = false;
layout(constant_id = 14) const bool WHOLE = false; // whether `inner` is a multiple of TILE_K

const uint SUBGROUP_M = REPEAT_M * MATRIX_M; // rows and columns of a subgroup
const uint SUBGROUP_N = REPEAT_N * MATRIX_N;
const uint TILE_M = SUBGROUPS / SUBGROUPS_N * SUBGROUP_M;
const uint TILE_N = SUBGROUPS_N * SUBGROUP_N;
// Vectors of 8 factors, 16 bytes of padding per row: no bank conflicts, aligned matrix loads.
const uint PIECES = TILE_K / 8;
const uint STRIDE = PIECES + QUAD;
const uint STAGE = (TILE_M + TILE_N) * STRIDE;
const uint STRIP_STRIDE = (SUBGROUP_N / 4 + 1) * QUAD;
const uint STRIP = MATRIX_M * STRIP_STRIDE; // one row of a subgroup's matrices
const uint SHARED = STAGE > SUBGROUPS * STRIP ? STAGE : SUBGROUPS * STRIP;
const uint THREADS = gl_WorkGroupSize.x;
const uint A_LOADS = (TILE_M * PIECES + THREADS - 1) / THREADS;
const uint W_LOADS = (TILE_N * PIECES + THREADS - 1) / THREADS;
// Quads of sums per quad of results.
const uint MERGED = ACTIVATION == 2 ? 2 : 1;

layout(set = 0, binding = 0) readonly buffer A { Piece a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { Piece weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { vec4 bias[]; };
layout(set = 0, binding = 3) readonly buffer Gamma { vec4 gamma[]; };
layout(set = 0, binding = 4) readonly buffer Residual { vec4 residual[]; };
layout(set = 0, binding = 5) buffer Out { OUTPUT4 result[]; };
layout(set = 0, binding = 6) readonly buffer RowScales { float row_scales[]; };
layout(set = 0, binding = 7) readonly buffer ColumnScales { vec4 column_scales[]; };
layout(set = 0, binding = 8) readonly buffer Integers { uvec2 integers[]; };
layout(set = 0, binding = 9) readonly buffer Scales { uint scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
    uint share;
};

shared Piece staged[SHARED];

Piece next_a[A_LOADS];
Piece next_weight[W_LOADS];
uint first_a[A_LOADS]; // pieces of this lane in tile 0
uint first_weight[W_LOADS];

#if FACTOR_IS_I8
Piece weight_at(uint at) { return weight[at]; }
Piece factors(Piece loaded) { return loaded; }
#else
// If Q8: two words of integers, one of scales, and which of its two applies.
Piece weight_at(uint at) {
    if (!Q8) return weight[at];
    uint group = at / (Q8_GROUP / 8);
    return Piece(integers[at], scales[group / 2], group % 2);
}

Piece factors(Piece loaded) {
    if (!Q8) return loaded;
    float scale = unpackHalf2x16(loaded.z)[loaded.w];
    return Piece(pack_FACTOR4(q8_integers(loaded.x) * scale), pack_FACTOR4(q8_integers(loaded.y) * scale));
}
#endif

// Surplus rows and columns repeat the last.
void locate(uint first_row, uint first_column) {
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        first_a[i] = min(first_row + at / PIECES, rows - 1) * (inner / 8) + at % PIECES;
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        first_weight[i] = min(first_column + at / PIECES, columns - 1) * (inner / 8) + at % PIECES;
    }
}

// Terms past `inner` are 0.
void load(uint tile) {
    uint piece = tile * PIECES;
    // PIECES divides THREADS.
    bool real = WHOLE || piece + gl_LocalInvocationID.x % PIECES < inner / 8;
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) next_a[i] = real ? a[first_a[i] + piece] : Piece(0);
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        next_weight[i] = real ? weight_at(first_weight[i] + piece) : Piece(0);
    }
}

void stage() {
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (TILE_M * PIECES % THREADS == 0 || at < TILE_M * PIECES) {
            staged[at / PIECES * STRIDE + at % PIECES] = next_a[i];
        }
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (TILE_N * PIECES % THREADS == 0 || at < TILE_N * PIECES) {
            staged[(TILE_M + at / PIECES) * STRIDE + at % PIECES] = factors(next_weight[i]);
        }
    }
}

// Four biased sums at `at` of the strip; `column` counts quads.
vec4 sums_at(uint at, uint row, uint column) {
#if FACTOR_IS_I8
    vec4 sum = vec4(ivec4(staged[at], staged[at + 1])) * (row_scales[row] * column_scales[column]);
#else
    vec4 sum = uintBitsToFloat(staged[at]);
#endif
    return SPLIT ? sum : sum + bias[column];
}

// Stores the quad of results that starts at `quad` of the strip's row.
void finish(uint strip, uint quad, uint row, uint column) {
    vec4 v = sums_at(strip + quad * QUAD, row, column);
    if (ACTIVATION == 1) v = vec4(gelu(v.x), gelu(v.y), gelu(v.z), gelu(v.w));
    if (ACTIVATION == 2) {
        vec4 w = sums_at(strip + (quad + 1) * QUAD, row, column + 1);
        v = vec4(silu(v.x) * v.y, silu(v.z) * v.w, silu(w.x) * w.y, silu(w.z) * w.w);
    }
    if (SCALE) v *= gamma[column];
    uint at = ((SPLIT ? gl_WorkGroupID.z * rows : 0) + row) * (columns / 4 / MERGED) + column / MERGED;
    if (ADD) v += residual[at];
    result[at] = to_OUTPUT4(v);
}

void main() {
    uint first_row = gl_WorkGroupID.y * TILE_M;
    uint first_column = gl_WorkGroupID.x * TILE_N;
    uint own_row = gl_SubgroupID / SUBGROUPS_N * SUBGROUP_M;
    uint own_column = gl_SubgroupID % SUBGROUPS_N * SUBGROUP_N;

    Sums sums[REPEAT_M * REPEAT_N];
    [[unroll]] for (uint i = 0; i < REPEAT_M * REPEAT_N; i++) sums[i] = Sums(0);

    uint first = SPLIT ? gl_WorkGroupID.z * share / TILE_K : 0;
    uint tiles = ((SPLIT ? min(first * TILE_K + share, inner) : inner) + TILE_K - 1) / TILE_K;
    locate(first_row, first_column);
    load(first);
    for (uint tile = first; tile < tiles; tile++) {
        barrier();
        stage();
        barrier();
        if (tile + 1 < tiles) load(tile + 1);
        [[unroll]] for (uint k = 0; k < TILE_K / MATRIX_K; k++) {
            Left left[REPEAT_M];
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                uint at = (own_row + m * MATRIX_M) * STRIDE + k * MATRIX_K / 8;
                coopMatLoad(left[m], staged, at, STRIDE, ROW_MAJOR);
            }
            [[unroll]] for (uint n = 0; n < REPEAT_N; n++) {
                Right right;
                uint at = (TILE_M + own_column + n * MATRIX_N) * STRIDE + k * MATRIX_K / 8;
                coopMatLoad(right, staged, at, STRIDE, COLUMN_MAJOR);
                [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                    sums[m * REPEAT_N + n] = coopMatMulAdd(left[m], right, sums[m * REPEAT_N + n]);
                }
            }
        }
    }

    barrier();
    uint strip = gl_SubgroupID * STRIP;
    const uint quads = SUBGROUP_N / 4 / MERGED;
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        [[unroll]] for (uint n = 0; n < REPEAT_N; n++) {
            uint at = strip + n * MATRIX_N / 4 * QUAD;
            coopMatStore(sums[m * REPEAT_N + n], staged, at, STRIP_STRIDE, ROW_MAJOR);
        }
        subgroupBarrier();
        for (uint i = gl_SubgroupInvocationID; i < MATRIX_M * quads; i += gl_SubgroupSize) {
            uint row = first_row + own_row + m * MATRIX_M + i / quads;
            uint quad = i % quads * MERGED;
            uint column = (first_column + own_column) / 4 + quad;
            if (row < rows && 4 * column < columns) finish(strip + i / quads * STRIP_STRIDE, quad, row, column);
        }
        subgroupBarrier();
    }
}
