// Softmax attention on matrix units, of ops/attention_matrix and ops/attention_converting.
//
// One workgroup owns SUBGROUPS * ROWS queries of a head, one subgroup ROWS of them. Shared memory
// stages TILE keys and values. Scores and sums are matrices of one type, so their components share
// a layout. With CONVERTS, MATRIX_N is MATRIX_K.
// Source: FlashAttention-2 (Dao 2023).
#extension GL_KHR_shader_subgroup_shuffle : require
#extension GL_KHR_shader_subgroup_vote : require
#include "shared/matrices.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 5) const uint REPEAT_M = 2; // matrices along a subgroup's queries
layout(constant_id = 6) const uint TILE = 64;    // keys in shared memory
layout(constant_id = 7) const uint CHANNELS = 64; // of a head, padded to whole matrices
layout(constant_id = 8) const bool POOLED = false;
// Rescales and biases every tile: lavapipe's subgroup barriers wait for the whole workgroup, and it
// compiles a second loop slowly.
layout(constant_id = 9) const bool CPU = false;

const uint THREADS = gl_WorkGroupSize.x;
const uint LANES = THREADS / SUBGROUPS;
const uint ELEMENTS = MATRIX_M * MATRIX_N / LANES; // components of a lane
const uint ROWS = REPEAT_M * MATRIX_M;
const uint STEPS = CHANNELS / MATRIX_K;  // matrices along the queries' channels
const uint BLOCKS = CHANNELS / MATRIX_N; // matrices along the sums' channels
const uint KEYS = TILE / MATRIX_N;       // matrices along the keys
// 16-byte vectors, one of padding per row against bank conflicts.
const uint PIECES = CHANNELS / 8;
const uint STRIDE = PIECES + 1;
const uint LOADS = (TILE * PIECES + THREADS - 1) / THREADS;
const uint GROUP = MATRIX_N > MATRIX_K ? MATRIX_N : MATRIX_K; // keys weighed at once
#if CONVERTS
const uint WEIGHTS = 0;
#else
const uint WEIGHT_STRIDE = TILE / 8 + 1;
const uint WEIGHTS = ROWS * WEIGHT_STRIDE;
#endif
// A strip holds MATRIX_M rows of f32.
const uint STRIP = FACTOR_IS_F16 == 1 ? 0 : WEIGHTS;
const uint STRIP_STRIDE = (CHANNELS > GROUP ? CHANNELS : GROUP) / 4 + 1;
const uint STRIP_END = STRIP + MATRIX_M * STRIP_STRIDE;
const uint SCRATCH = STRIP_END > WEIGHTS ? STRIP_END : WEIGHTS;

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
    uint common_keys;
    uint own_first;
};

shared uvec4 staged[2 * TILE * STRIDE];
// Apart from the staged values, whose loads would wait for its stores.
shared uvec4 scratch[SUBGROUPS * SCRATCH];
shared float biases[TILE]; // first summand of a tile's scores

uvec4 next_k[LOADS];
uvec4 next_v[LOADS];
Left query[REPEAT_M * STEPS];
Sums score[REPEAT_M * KEYS];
Sums sums[REPEAT_M * BLOCKS];
uint own; // first vector of this subgroup in scratch

// Common keys have the first tiles.
uint common_tiles() { return POOLED ? (common_keys + TILE - 1) / TILE : 0; }

bool is_common(uint tile) { return POOLED && tile < common_tiles(); }

// The tile's keys before the end of its keys.
uint keys_of(uint tile) { return is_common(tile) ? common_keys - tile * TILE : keys - (tile - common_tiles()) * TILE; }

void load(uint tile) {
    uint own_row = own_first + (gl_WorkGroupID.y * sequences + gl_WorkGroupID.z) * keys;
    uint row = is_common(tile) ? gl_WorkGroupID.y * common_keys + tile * TILE : own_row + (tile - common_tiles()) * TILE;
    uint last = keys_of(tile) * PIECES - 1;
    [[unroll]] for (uint i = 0; i < LOADS; i++) {
        uint at = row * PIECES + min(i * THREADS + gl_LocalInvocationID.x, last);
        next_k[i] = k[at];
        next_v[i] = v[at];
    }
}

void stage() {
    [[unroll]] for (uint i = 0; i < LOADS; i++) {
        uint at = i * THREADS + gl_LocalInvocationID.x;
        if (TILE * PIECES % THREADS == 0 || at < TILE * PIECES) {
            staged[at / PIECES * STRIDE + at % PIECES] = next_k[i];
            staged[(TILE + at / PIECES) * STRIDE + at % PIECES] = next_v[i];
        }
    }
}

void stage_biases(uint tile) {
    uint count = keys_of(tile);
    for (uint i = gl_LocalInvocationID.x; i < TILE; i += THREADS) {
        uint at = gl_WorkGroupID.z * common_keys + min(tile * TILE + i, common_keys - 1);
        float bias = POOLED ? log_counts[at] : 0.0;
        biases[i] = i < count ? (is_common(tile) ? bias : 0.0) : LOWEST;
    }
}

#include "shared/running_softmax.glsl"

// Adds a group of values, times their weights.
void add_values(uint group) {
    [[unroll]] for (uint c = group * GROUP / MATRIX_K; c < (group + 1) * GROUP / MATRIX_K; c++) {
        Left weight[REPEAT_M];
        [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
#if CONVERTS
            weight[m] = Left(score[m * KEYS + c]);
#else
            uint at = own + m * MATRIX_M * WEIGHT_STRIDE + c * MATRIX_K / 8;
            coopMatLoad(weight[m], scratch, at, WEIGHT_STRIDE, ROW_MAJOR);
#endif
        }
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
            Right value;
            coopMatLoad(value, staged, (TILE + c * MATRIX_K) * STRIDE + n * MATRIX_N / 8, STRIDE, ROW_MAJOR);
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                sums[m * BLOCKS + n] = coopMatMulAdd(weight[m], value, sums[m * BLOCKS + n]);
            }
        }
    }
}

// Attends to the loaded tile, and loads the next of `tiles`.
void attend(uint tile, uint tiles, const bool biased) {
    barrier();
    stage();
    if (biased) stage_biases(tile);
    barrier();
    if (tile + 1 < tiles) load(tile + 1);
    [[unroll]] for (uint n = 0; n < KEYS; n++) {
        Sums bias = Sums(0);
        if (biased) coopMatLoad(bias, biases, n * MATRIX_N, 0, ROW_MAJOR); // every row is the same
        [[unroll]] for (uint m = 0; m < REPEAT_M; m++) score[m * KEYS + n] = bias;
        [[unroll]] for (uint c = 0; c < STEPS; c++) {
            Right key;
            coopMatLoad(key, staged, n * MATRIX_N * STRIDE + c * MATRIX_K / 8, STRIDE, COLUMN_MAJOR);
            [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
                score[m * KEYS + n] = coopMatMulAdd(query[m * STEPS + c], key, score[m * KEYS + n]);
            }
        }
    }
    rescale();
    [[unroll]] for (uint group = 0; group < TILE / GROUP; group++) {
        weigh(group);
        add_values(group);
    }
}

void main() {
    uint head_sequence = gl_WorkGroupID.y * sequences + gl_WorkGroupID.z;
    uint first_query = (gl_WorkGroupID.x * SUBGROUPS + gl_SubgroupID) * ROWS;
    own = gl_SubgroupID * SCRATCH;

    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        // Surplus queries load arbitrary rows; their results are dropped.
        uint at = (head_sequence * queries + min(first_query, queries) + m * MATRIX_M) * PIECES;
        [[unroll]] for (uint c = 0; c < STEPS; c++) {
            coopMatLoad(query[m * STEPS + c], q, at + c * MATRIX_K / 8, PIECES, ROW_MAJOR);
        }
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) sums[m * BLOCKS + n] = Sums(0);
    }
    softmax_begin();

    uint tiles = common_tiles() + (keys + TILE - 1) / TILE;
    uint unbiased = POOLED || CPU ? 0 : keys / TILE;
    load(0);
    for (uint tile = 0; tile < unbiased; tile++) attend(tile, tiles, false);
    for (uint tile = unbiased; tile < tiles; tile++) attend(tile, tiles, true);

    softmax_end();
    uint strip = own + STRIP;
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        subgroupBarrier();
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
            coopMatStore(sums[m * BLOCKS + n], scratch, strip + n * MATRIX_N / 4, STRIP_STRIDE, ROW_MAJOR);
        }
        subgroupBarrier();
        for (uint i = gl_SubgroupInvocationID; i < MATRIX_M * CHANNELS / 4; i += LANES) {
            uint query_row = first_query + m * MATRIX_M + i / (CHANNELS / 4);
            uint quad = i % (CHANNELS / 4);
            if (query_row < queries && 4 * quad < dim) {
                uint at = ((gl_WorkGroupID.z * queries + query_row) * heads + gl_WorkGroupID.y) * dim / 4 + quad;
                result[at] = to_FACTOR4(uintBitsToFloat(scratch[strip + i / (CHANNELS / 4) * STRIP_STRIDE + quad]));
            }
        }
    }
}
