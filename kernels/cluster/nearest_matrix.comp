// Two nearest targets of every point per share of the targets, by |t|^2 / 2 - p t on matrix units.
//
// Points       [points, pieces, 2, 8] FACTOR, of cluster/halves
// PointScales  [points] f32
// Targets      [targets, pieces, 2, 8] FACTOR, of cluster/halves with the same origin
// TargetScales [targets] f32, padded to vec4
// TargetNorms  [targets] f32, half the squared length, padded to vec4
// Candidates   [shares, points] u32, two least distinct scores: (bits, first target), or infinity
//
// p t is high * high + high * low + low * high. Matrix units, which may truncate, sum CHUNK
// channels; f32 sums chunks. A score's error is at most
//     (gamma(6 CHUNK + width / CHUNK + 1) + 3 * 2^-22 + 2^-27 sqrt(width)) |p| |t|
//     + gamma(width / 16 + 134) |t|^2 / 2 + 2 u (|p| + |t|)^2
// with gamma(n) = n u / (1 - n u), u = 2^-24: below 2^-16 (|p| + |t|)^2 up to 2048 channels.
//
// One workgroup owns TILE_M points, a subgroup REPEAT_M x REPEAT_N matrices. Shared memory
// double-buffers TILE_K channels. Source: flash k-means, without a distance matrix.
#version 460
#pragma factor f16
#extension GL_GOOGLE_include_directive : require
#include "shared/matrices.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 5) const uint SUBGROUPS_N = 2; // along the targets
layout(constant_id = 6) const uint REPEAT_M = 4;    // matrices of a subgroup
layout(constant_id = 7) const uint REPEAT_N = 2;
layout(constant_id = 8) const uint TILE_K = 16;

const uint CHUNK = 64; // channels
const uint SUBGROUP_N = REPEAT_N * MATRIX_N; // targets of a subgroup
const uint TILE_M = SUBGROUPS / SUBGROUPS_N * REPEAT_M * MATRIX_M;
const uint TILE_N = SUBGROUPS_N * SUBGROUP_N;
const uint THREADS = gl_WorkGroupSize.x;
const uint LANES = THREADS / SUBGROUPS;
// Vectors of 8 halves, high then low, one of padding per row against bank conflicts.
const uint PIECES = TILE_K / 8;
const uint HALVES = 2 * PIECES;
const uint STRIDE = HALVES + 1;
const uint STAGE = (TILE_M + TILE_N) * STRIDE;
const uint POINT_LOADS = (TILE_M * HALVES + THREADS - 1) / THREADS;
const uint TARGET_LOADS = (TILE_N * HALVES + THREADS - 1) / THREADS;

layout(set = 0, binding = 0) readonly buffer Points { Piece points[]; };
layout(set = 0, binding = 1) readonly buffer PointScales { float point_scales[]; };
layout(set = 0, binding = 2) readonly buffer Targets { Piece targets[]; };
layout(set = 0, binding = 3) readonly buffer TargetScales { vec4 target_scales[]; };
layout(set = 0, binding = 4) readonly buffer TargetNorms { vec4 target_norms[]; };
layout(set = 0, binding = 5) writeonly buffer Candidates { uvec4 candidates[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint column_count; // targets
    uint pieces;       // of 8 channels
    uint share;        // targets of a workgroup, a multiple of TILE_N
};

const uint STRIPS = SUBGROUPS * MATRIX_M * (SUBGROUP_N / 4 + 1);
const uint ENDS = TILE_M * SUBGROUPS_N * (LANES > MATRIX_M ? LANES / MATRIX_M : 1);
const uint LARGER = STRIPS > ENDS ? STRIPS : ENDS;
shared Piece staged[2 * STAGE > LARGER ? 2 * STAGE : LARGER];

#include "shared/running_minimum.glsl"

Piece next_points[POINT_LOADS];
Piece next_targets[TARGET_LOADS];
Sums products[REPEAT_M * REPEAT_N];
Sums chunk[REPEAT_M * REPEAT_N];
float point_scale[OWN_ROWS];

vec4 scores_of(vec4 values, uint own, uint column) {
    // In this order: the product of both scales may underflow.
    precise vec4 scaled = values * point_scale[own];
    scaled *= target_scales[column / 4];
    return target_norms[column / 4] - scaled;
}

// Surplus rows repeat the last; channels past the last are 0.
void load(uint first_point, uint first_target, uint tile) {
    [[unroll]] for (uint i = 0; i < POINT_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        uint piece = tile * HALVES + at % HALVES;
        uint row = min(first_point + at / HALVES, point_count - 1);
        next_points[i] = piece < 2 * pieces ? points[row * 2 * pieces + piece] : Piece(0);
    }
    [[unroll]] for (uint i = 0; i < TARGET_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        uint piece = tile * HALVES + at % HALVES;
        uint row = min(first_target + at / HALVES, column_count - 1);
        next_targets[i] = piece < 2 * pieces ? targets[row * 2 * pieces + piece] : Piece(0);
    }
}

// High and low vectors alternate in global memory.
uint staged_at(uint at) { return at / HALVES * STRIDE + at % 2 * PIECES + at % HALVES / 2; }

void stage(uint base) {
    [[unroll]] for (uint i = 0; i < POINT_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (at < TILE_M * HALVES) staged[base + staged_at(at)] = next_points[i];
    }
    [[unroll]] for (uint i = 0; i < TARGET_LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (at < TILE_N * HALVES) staged[base + TILE_M * STRIDE + staged_at(at)] = next_targets[i];
    }
}

// Adds products of TILE_K channels of the rows at `left` and `right`, interleaved to hide latency.
void multiply(uint left, uint right) {
    [[unroll]] for (uint k = 0; k < PIECES; k += MATRIX_K / 8) {
        Left high[REPEAT_M];
        Left low[REPEAT_M];
        [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
            uint at = left + m * MATRIX_M * STRIDE + k;
            coopMatLoad(high[m], staged, at, STRIDE, ROW_MAJOR);
            coopMatLoad(low[m], staged, at + PIECES, STRIDE, ROW_MAJOR);
        }
        [[unroll]] for (uint n = 0; n < REPEAT_N; n++) {
            Right target_high, target_low;
            uint at = right + n * MATRIX_N * STRIDE + k;
            coopMatLoad(target_high, staged, at, STRIDE, COLUMN_MAJOR);
            coopMatLoad(target_low, staged, at + PIECES, STRIDE, COLUMN_MAJOR);
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                chunk[m * REPEAT_N + n] = coopMatMulAdd(low[m], target_high, chunk[m * REPEAT_N + n]);
            }
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                chunk[m * REPEAT_N + n] = coopMatMulAdd(high[m], target_low, chunk[m * REPEAT_N + n]);
            }
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                chunk[m * REPEAT_N + n] = coopMatMulAdd(high[m], target_high, chunk[m * REPEAT_N + n]);
            }
        }
    }
}

void add_chunk() {
    [[unroll]] for (uint i = 0; i < REPEAT_M * REPEAT_N; i++) {
        products[i] += chunk[i];
        chunk[i] = Sums(0);
    }
}

void main() {
    uint first_point = gl_WorkGroupID.y * TILE_M;
    uint begin = gl_WorkGroupID.x * share, end = min(begin + share, column_count);
    uint own_point = gl_SubgroupID / SUBGROUPS_N * REPEAT_M * MATRIX_M;
    uint own_target = gl_SubgroupID % SUBGROUPS_N * SUBGROUP_N;
    uint strip = gl_SubgroupID * MATRIX_M * STRIP_STRIDE;
    [[unroll]] for (uint own = 0; own < OWN_ROWS; own++) {
        point_scale[own] = point_scales[min(first_point + own_point + row_in_subgroup(own), point_count - 1)];
    }
    minimum_begin();

    uint tiles = (pieces + PIECES - 1) / PIECES;
    load(first_point, begin, 0);
    for (uint first_target = begin; first_target < end; first_target += TILE_N) {
        [[unroll]] for (uint i = 0; i < REPEAT_M * REPEAT_N; i++) {
            products[i] = Sums(0);
            chunk[i] = Sums(0);
        }
        stage(0);
        barrier();
        for (uint tile = 0; tile < tiles; tile++) {
            bool more = tile + 1 < tiles;
            load(first_point, more ? first_target : first_target + TILE_N, more ? tile + 1 : 0);
            uint base = tile % 2 * STAGE;
            multiply(base + own_point * STRIDE, base + (TILE_M + own_target) * STRIDE);
            if (!more || (tile + 1) * TILE_K % CHUNK == 0) add_chunk();
            if (more) stage(STAGE - base);
            barrier();
        }
        [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
            [[unroll]] for (uint n = 0; n < REPEAT_N; n++) {
                coopMatStore(products[m * REPEAT_N + n], staged, strip + n * MATRIX_N / 4, STRIP_STRIDE, ROW_MAJOR);
            }
            subgroupBarrier();
            minimum(strip, m, first_target + own_target);
            subgroupBarrier();
        }
        barrier();
    }

    minimum_end(own_point, gl_SubgroupID % SUBGROUPS_N);
    barrier();
    for (uint row = gl_LocalInvocationID.x; row < TILE_M && first_point + row < point_count; row += THREADS) {
        candidates[gl_WorkGroupID.x * point_count + first_point + row] = minimum_of(row);
    }
}
