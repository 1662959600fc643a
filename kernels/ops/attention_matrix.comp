// Softmax attention of one head over one sequence on matrix units.
//
// Q         [heads, sequences * queries, CHANNELS] FACTOR, scaled by 1 / sqrt(head size),
//           readable one workgroup past its end
// K, V      [heads, sequences * keys, CHANNELS] FACTOR, 0 past the head size
// LogCounts [sequences * keys] f32, log of the number of pooled patches; read if POOLED
// Out       [sequences * queries, heads * dim] FACTOR, saturated
//
// One workgroup owns SUBGROUPS * ROWS queries of a head, one subgroup ROWS of them. Shared memory
// stages TILE keys and values, and the f32 scores, whose rows are not addressable in matrices.
// Source: FlashAttention-2 (Dao 2023).
#version 460
#pragma factor f16 bf16
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_vote : require
#include "shared/matrices.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 5) const uint REPEAT_M = 2; // matrices along a subgroup's queries
layout(constant_id = 6) const uint TILE = 32;    // keys in shared memory
layout(constant_id = 7) const uint CHANNELS = 64; // of a head, padded to whole matrices
layout(constant_id = 8) const bool POOLED = false;

const uint THREADS = gl_WorkGroupSize.x;
const uint LANES = THREADS / SUBGROUPS;
const uint ROWS = REPEAT_M * MATRIX_M;
const uint STEPS = CHANNELS / MATRIX_K;  // matrices along the queries' channels
const uint BLOCKS = CHANNELS / MATRIX_N; // matrices along the sums' channels
// 16-byte vectors, one of padding per row against bank conflicts.
const uint PIECES = CHANNELS / 8;
const uint STRIDE = PIECES + 1;
const uint LOADS = (TILE * PIECES + THREADS - 1) / THREADS;
const uint SCORE_STRIDE = TILE / 4 + 1;

layout(set = 0, binding = 0) readonly buffer Q { uvec4 q[]; };
layout(set = 0, binding = 1) readonly buffer K { uvec4 k[]; };
layout(set = 0, binding = 2) readonly buffer V { uvec4 v[]; };
layout(set = 0, binding = 3) writeonly buffer Out { FACTOR4 result[]; };
layout(set = 0, binding = 4) readonly buffer LogCounts { float log_counts[]; };

layout(push_constant) uniform Push {
    uint queries;
    uint keys;
    uint sequences;
    uint heads;
    uint dim;
};

shared uvec4 staged[2 * TILE * STRIDE + SUBGROUPS * ROWS * SCORE_STRIDE];

uvec4 next_k[LOADS];
uvec4 next_v[LOADS];
Sums sums[REPEAT_M * BLOCKS];

// Log counts of 4 keys.
vec4 more(uint first_key) {
    vec4 sum;
    uint first = gl_WorkGroupID.z * keys;
    [[unroll]] for (uint i = 0; i < 4; i++) sum[i] = log_counts[first + min(first_key + i, keys - 1)];
    return sum;
}

#include "shared/running_softmax.glsl"

void load(uint base, uint first_key) {
    [[unroll]] for (uint i = 0; i < LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        bool real = first_key + at / PIECES < keys;
        next_k[i] = real ? k[base + first_key * PIECES + at] : uvec4(0);
        next_v[i] = real ? v[base + first_key * PIECES + at] : uvec4(0);
    }
}

void stage() {
    [[unroll]] for (uint i = 0; i < LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (at < TILE * PIECES) {
            staged[at / PIECES * STRIDE + at % PIECES] = next_k[i];
            staged[(TILE + at / PIECES) * STRIDE + at % PIECES] = next_v[i];
        }
    }
}

void scale_sums(uint scores) {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        Sums factor;
        coopMatLoad(factor, staged, scores + m * MATRIX_M * SCORE_STRIDE + RESCALE, SCORE_STRIDE, ROW_MAJOR);
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) sums[m * BLOCKS + n] = sums[m * BLOCKS + n] * factor;
    }
}

void main() {
    uint head_sequence = gl_WorkGroupID.y * sequences + gl_WorkGroupID.z;
    uint first_query = (gl_WorkGroupID.x * SUBGROUPS + gl_SubgroupID) * ROWS;
    uint kv_base = head_sequence * keys * PIECES;
    uint scores = 2 * TILE * STRIDE + gl_SubgroupID * ROWS * SCORE_STRIDE;

    Left query[REPEAT_M * STEPS];
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        // Surplus queries load arbitrary rows; their results are dropped.
        uint at = (head_sequence * queries + min(first_query, queries) + m * MATRIX_M) * PIECES;
        [[unroll]] for (uint c = 0; c < STEPS; c++) {
            coopMatLoad(query[m * STEPS + c], q, at + c * MATRIX_K / 8, PIECES, ROW_MAJOR);
        }
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) sums[m * BLOCKS + n] = Sums(0);
    }
    softmax_begin();

    load(kv_base, 0);
    for (uint first_key = 0; first_key < keys; first_key += TILE) {
        barrier();
        stage();
        barrier();
        if (first_key + TILE < keys) load(kv_base, first_key + TILE);
        [[unroll]] for (uint n = 0; n < TILE / MATRIX_N; n++) {
            Sums score[REPEAT_M];
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) score[m] = Sums(0);
            [[unroll]] for (uint c = 0; c < STEPS; c++) {
                Right key;
                uint at = n * MATRIX_N * STRIDE + c * MATRIX_K / 8;
                coopMatLoad(key, staged, at, STRIDE, COLUMN_MAJOR);
                [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                    score[m] = coopMatMulAdd(query[m * STEPS + c], key, score[m]);
                }
            }
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                uint at = scores + m * MATRIX_M * SCORE_STRIDE + n * MATRIX_N / 4;
                coopMatStore(score[m], staged, at, SCORE_STRIDE, ROW_MAJOR);
            }
        }
        subgroupBarrier();
        bool changed = softmax(scores, first_key, keys);
        subgroupBarrier();
        if (subgroupAny(changed)) scale_sums(scores);
        [[unroll]] for (uint c = 0; c < TILE / MATRIX_K; c++) {
            Left weight[REPEAT_M];
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                uint at = scores + m * MATRIX_M * SCORE_STRIDE + c * MATRIX_K / 8;
                coopMatLoad(weight[m], staged, at, SCORE_STRIDE, ROW_MAJOR);
            }
            [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
                Right value;
                uint at = (TILE + c * MATRIX_K) * STRIDE + n * MATRIX_N / 8;
                coopMatLoad(value, staged, at, STRIDE, ROW_MAJOR);
                [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                    sums[m * BLOCKS + n] = coopMatMulAdd(weight[m], value, sums[m * BLOCKS + n]);
                }
            }
        }
    }

    subgroupBarrier();
    softmax_end(scores);
    subgroupBarrier();
    scale_sums(scores);
    // The scores' shared memory stages one column of matrices at a time.
    [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
        subgroupBarrier();
        [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
            uint row = scores + m * MATRIX_M * SCORE_STRIDE;
            coopMatStore(sums[m * BLOCKS + n], staged, row, SCORE_STRIDE, ROW_MAJOR);
        }
        subgroupBarrier();
        for (uint i = gl_SubgroupInvocationID; i < ROWS * MATRIX_N / 4; i += LANES) {
            uint row = i / (MATRIX_N / 4);
            uint quad = i % (MATRIX_N / 4);
            uint channel = n * MATRIX_N + 4 * quad;
            if (first_query + row < queries && channel < dim) {
                uint query_row = gl_WorkGroupID.z * queries + first_query + row;
                vec4 value = uintBitsToFloat(staged[scores + row * SCORE_STRIDE + quad]);
                result[((query_row * heads + gl_WorkGroupID.y) * dim + channel) / 4] = to_FACTOR4(value);
            }
        }
    }
}
