// Softmax attention of one head over one sequence.
//
// Q         [heads, sequences * queries, DIM] ELEMENT, scaled by 1 / sqrt(DIM)
// K         [heads, DIM, common_keys] ELEMENT, keys padded to a multiple of 4; from row own_first
//           on [heads, sequences, DIM, keys] of each sequence's own, padded alike
// V         [heads, common_keys, DIM] ELEMENT; from row own_first on [heads, sequences * keys, DIM]
// LogCounts [sequences, common_keys] f32, added to scores; read if POOLED, else common_keys is 0
// Out       [sequences * queries, heads * DIM] ELEMENT
//
// One subgroup owns ROWS queries of a head. A lane scores 4 keys, then gathers 4 channels VECTORS
// times. PARTS groups of lanes gather different keys.
// Source: FlashAttention (Dao et al. 2022).
#version 460
#pragma element ELEMENT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/limits.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const uint DIM = 64;
layout(constant_id = 2) const uint VECTORS = 2; // ceil(DIM / (4 * subgroup size))
layout(constant_id = 3) const uint PARTS = 1; // power of two <= 4 * subgroup size / DIM
layout(constant_id = 4) const bool POOLED = false;

const uint ROWS = ATTENTION_ROWS;

layout(set = 0, binding = 0) readonly buffer Q { ELEMENT4 q[]; };
layout(set = 0, binding = 1) readonly buffer K { ELEMENT4 k[]; };
layout(set = 0, binding = 2) readonly buffer V { ELEMENT4 v[]; };
layout(set = 0, binding = 3) writeonly buffer Out { ELEMENT4 result[]; };
layout(set = 0, binding = 4) readonly buffer LogCounts { float log_counts[]; };

layout(push_constant) uniform Push {
    uint queries;
    uint keys;
    uint sequences;
    uint heads;
    uint common_keys;
    uint own_first;
};

const uint QUADS = DIM / 4;

shared vec4 weights[ROWS][gl_WorkGroupSize.x];

// Running maximum, sum of weights and weighted sum of values of each query.
float highest[ROWS];
float total[ROWS];
vec4 sum[ROWS][VECTORS];

// Scores the lane's 4 keys at `k_at`.
void score(uint q_at[ROWS], uint k_at, uint key_quads, out vec4 scores[ROWS]) {
    [[unroll]] for (uint r = 0; r < ROWS; r++) scores[r] = vec4(0.0);
    for (uint c = 0; c < QUADS; c++) {
        uint at = k_at + 4 * c * key_quads;
        vec4 k0 = from_ELEMENT4(k[at]);
        vec4 k1 = from_ELEMENT4(k[at + key_quads]);
        vec4 k2 = from_ELEMENT4(k[at + 2 * key_quads]);
        vec4 k3 = from_ELEMENT4(k[at + 3 * key_quads]);
        [[unroll]] for (uint r = 0; r < ROWS; r++) {
            vec4 x = from_ELEMENT4(q[q_at[r] + c]);
            scores[r] += x.x * k0;
            scores[r] += x.y * k1;
            scores[r] += x.z * k2;
            scores[r] += x.w * k3;
        }
    }
}

void weigh(uint sequence, uint first_key, inout vec4 scores[ROWS]) {
    vec4 more;
    [[unroll]] for (uint i = 0; i < 4; i++) {
        more[i] = log_counts[sequence * common_keys + min(first_key + i, common_keys - 1)];
    }
    [[unroll]] for (uint r = 0; r < ROWS; r++) scores[r] += more;
}

// Turns scores into shared weights and rescales the running sums.
void softmax(uint first_key, uint end, vec4 scores[ROWS]) {
    bvec4 real = lessThan(first_key + uvec4(0, 1, 2, 3), uvec4(end));
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        vec4 s = mix(vec4(LOWEST), scores[r], real);
        float tile_highest = subgroupMax(max(max(s.x, s.y), max(s.z, s.w)));
        float now = max(highest[r], tile_highest);
        float keep = exp(highest[r] - now);
        vec4 w = mix(vec4(0.0), exp(s - now), real);
        highest[r] = now;
        total[r] = total[r] * keep + w.x + w.y + w.z + w.w;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] *= keep;
        weights[r][gl_LocalInvocationID.x] = w;
    }
}

// Adds the weighted values of a tile of keys before `end`.
void gather(uint v_base, uint first_key, uint end) {
    uint lanes = gl_WorkGroupSize.x;
    // Surplus lanes keep the loop uniform.
    uint part = gl_LocalInvocationID.x / QUADS % PARTS;
    uint first_channel = gl_LocalInvocationID.x % QUADS;
    uint tile_quads = min(lanes, (end - first_key + 3) / 4);
    for (uint first = 0; first < tile_quads; first += PARTS) {
        // Weights past the end are 0.
        uint j = first + part;
        uint key = first_key + 4 * j;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) {
            uint channel = min(first_channel + c * lanes, QUADS - 1);
            vec4 v0 = from_ELEMENT4(v[v_base + min(key, end - 1) * QUADS + channel]);
            vec4 v1 = from_ELEMENT4(v[v_base + min(key + 1, end - 1) * QUADS + channel]);
            vec4 v2 = from_ELEMENT4(v[v_base + min(key + 2, end - 1) * QUADS + channel]);
            vec4 v3 = from_ELEMENT4(v[v_base + min(key + 3, end - 1) * QUADS + channel]);
            [[unroll]] for (uint r = 0; r < ROWS; r++) {
                vec4 w = weights[r][j];
                sum[r][c] += w.x * v0;
                sum[r][c] += w.y * v1;
                sum[r][c] += w.z * v2;
                sum[r][c] += w.w * v3;
            }
        }
    }
}

// Sums the parts of query r and stores it as row `row`.
void store(uint r, uint row, float all) {
    uint lane = gl_LocalInvocationID.x, lanes = gl_WorkGroupSize.x;
    [[unroll]] for (uint c = 0; c < VECTORS; c++) {
        vec4 whole = sum[r][c];
        for (uint apart = PARTS / 2; apart > 0; apart /= 2) {
            whole += subgroupShuffle(whole, (lane + apart * QUADS) % lanes);
        }
        uint channel = lane + c * lanes;
        if (channel < QUADS) result[(row * heads + gl_WorkGroupID.y) * QUADS + channel] = to_ELEMENT4(whole / all);
    }
}

void main() {
    uint lanes = gl_WorkGroupSize.x;
    uint first_query = gl_WorkGroupID.x * ROWS;
    uint sequence = gl_WorkGroupID.z;
    uint head_sequence = gl_WorkGroupID.y * sequences + sequence;
    uint own_quads = (keys + 3) / 4;
    uint common_quads = POOLED ? (common_keys + 3) / 4 : 0;
    uint common_tiles = (common_quads + lanes - 1) / lanes;
    uint tiles = common_tiles + (own_quads + lanes - 1) / lanes;

    uint q_at[ROWS];
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        q_at[r] = (head_sequence * queries + min(first_query + r, queries - 1)) * QUADS;
        highest[r] = LOWEST;
        total[r] = 0.0;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] = vec4(0.0);
    }

    for (uint i = 0; i < tiles; i++) {
        bool own = !POOLED || i >= common_tiles;
        uint tile = (own ? i - common_tiles : i) * lanes;
        uint end = own ? keys : common_keys;
        uint key_quads = own ? own_quads : common_quads;
        uint k_base = own ? own_first * QUADS + head_sequence * DIM * own_quads
                          : gl_WorkGroupID.y * DIM * common_quads;
        uint v_base = (own ? own_first + head_sequence * keys : gl_WorkGroupID.y * common_keys) * QUADS;
        uint key_quad = tile + gl_LocalInvocationID.x;
        vec4 scores[ROWS];
        score(q_at, k_base + min(key_quad, key_quads - 1), key_quads, scores);
        if (!own) weigh(sequence, 4 * key_quad, scores);
        softmax(4 * key_quad, end, scores);
        subgroupMemoryBarrierShared();
        subgroupBarrier();
        gather(v_base, 4 * tile, end);
        subgroupBarrier();
    }

    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        float all = subgroupAdd(total[r]);
        uint query = first_query + r;
        if (query < queries) store(r, sequence * queries + query, all);
    }
}
