// Attention of ops/attention with uniform loads, for CPU drivers.
//
// Q         [heads, sequences * queries, DIM] f32, scaled by 1 / sqrt(DIM)
// K         [heads, panels, DIM, PANEL] f32, common_keys and padding; from row own_first on
//           [heads, sequences, panels, DIM, PANEL] of each sequence's own, padded alike
// V         [heads, common_keys, DIM] f32; from row own_first on [heads, sequences * keys, DIM]
// LogCounts [sequences, common_keys] f32, added to scores; read if POOLED, else common_keys is 0
// Out       [sequences * queries, heads * DIM] f32
//
// One subgroup owns TILE_ROWS queries of a head. A key's channels are in one memory page. See
// shared/uniform.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_ballot : require
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

#include "shared/uniform.glsl"

layout(constant_id = 1) const uint DIM = 64;
layout(constant_id = 2) const uint VECTORS = 8; // DIM / subgroup size
layout(constant_id = 3) const uint TERMS = 4; // score terms per loop pass; divides DIM
layout(constant_id = 4) const uint TILE_ROWS = 6;
layout(constant_id = 5) const uint KEY_VECTORS = 2;
layout(constant_id = 6) const bool POOLED = false;

layout(set = 0, binding = 0) readonly buffer Q { float q[]; };
layout(set = 0, binding = 1) readonly buffer K { float k[]; };
layout(set = 0, binding = 2) readonly buffer V { float v[]; };
layout(set = 0, binding = 3) writeonly buffer Out { float result[]; };
layout(set = 0, binding = 4) readonly buffer LogCounts { float log_counts[]; };

layout(push_constant) uniform Push {
    uint queries;
    uint keys;
    uint sequences;
    uint heads;
    uint common_keys;
    uint own_first;
    uvec2 q_address;
    uvec2 k_address;
    uvec2 v_address;
};

const uint PANEL = KEY_VECTORS * gl_WorkGroupSize.x;

// Running maximum, the lane's sum of weights, and weighted sum of values of each query.
uint64_t q_at[TILE_ROWS];
float highest[TILE_ROWS];
float total[TILE_ROWS];
float sum[TILE_ROWS][VECTORS];
// Scores, then weights.
float weight[TILE_ROWS][KEY_VECTORS];

uint64_t rows(uint count) { return 4 * uint64_t(count) * DIM; }

void score(uint64_t k_at) {
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) weight[r][n] = 0.0;
    }
    uint c = 0;
    do {
        uint64_t offset = 4 * uint64_t(c);
        [[unroll]] for (uint j = 0; j < TERMS; j++) {
            float key[KEY_VECTORS];
            [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) {
                key[n] = vector_at(k_at + offset * PANEL, j * PANEL + n * gl_WorkGroupSize.x);
            }
            [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
                float x = Values(q_at[r] + offset).values[j];
                [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) weight[r][n] += x * key[n];
            }
        }
        c += TERMS;
    } while (c < DIM);
}

void weigh(uint first, uint count) {
    [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) {
        float more = log_counts[first + min(n * gl_WorkGroupSize.x + lane, count - 1)];
        [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) weight[r][n] += more;
    }
}

// Turns `count` scores into weights, padding into 0, and rescales the running sums.
void softmax(uint count) {
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        float most = LOWEST;
        [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) {
            most = mix(most, max(most, weight[r][n]), n * gl_WorkGroupSize.x + lane < count);
        }
        float now = highest[r];
        [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) now = max(now, subgroupBroadcast(most, i));
        float keep = exp(highest[r] - now);
        highest[r] = now;
        total[r] *= keep;
        [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) {
            weight[r][n] = mix(0.0, exp(weight[r][n] - now), n * gl_WorkGroupSize.x + lane < count);
            total[r] += weight[r][n];
        }
        [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] *= keep;
    }
}

// Accumulates KEY_VECTORS channels in registers at once: as many sums as scores.
void gather(uint64_t v_at, uint count) {
    [[unroll]] for (uint first = 0; first < VECTORS; first += KEY_VECTORS) {
        [[unroll]] for (uint n = 0; n < KEY_VECTORS; n++) {
            [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) {
                // Padding has weight 0.
                uint key = min(n * gl_WorkGroupSize.x + i, count - 1);
                [[unroll]] for (uint c = first; c < min(first + KEY_VECTORS, VECTORS); c++) {
                    float value = vector_at(v_at, key * DIM + c * gl_WorkGroupSize.x);
                    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) sum[r][c] += subgroupBroadcast(weight[r][n], i) * value;
                }
            }
        }
    }
}

void main() {
    find_lanes();
    uint first_query = gl_WorkGroupID.x * TILE_ROWS;
    uint sequence = gl_WorkGroupID.z;
    uint head_sequence = gl_WorkGroupID.y * sequences + sequence;
    uint padded_common = POOLED ? (common_keys + PANEL - 1) / PANEL * PANEL : 0;
    uint padded_keys = (keys + PANEL - 1) / PANEL * PANEL;
    uint64_t k_base = packUint2x32(k_address), v_base = packUint2x32(v_address);
    uint64_t own_k = k_base + rows(own_first) + head_sequence * rows(padded_keys);
    uint64_t own_v = v_base + rows(own_first) + head_sequence * rows(keys);
    k_base += gl_WorkGroupID.y * rows(padded_common);
    v_base += gl_WorkGroupID.y * rows(common_keys);

    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        uint query = head_sequence * queries + min(first_query + r, queries - 1);
        q_at[r] = packUint2x32(q_address) + 4 * uint64_t(query) * DIM;
        highest[r] = LOWEST;
        total[r] = 0.0;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] = 0.0;
    }

    uint first = 0;
    do {
        bool own = !POOLED || first >= padded_common;
        uint key = own ? first - padded_common : first;
        uint count = min((own ? keys : common_keys) - key, PANEL);
        score((own ? own_k : k_base) + rows(key));
        if (!own) weigh(sequence * common_keys + key, count);
        softmax(count);
        gather((own ? own_v : v_base) + rows(key), count);
        first += PANEL;
    } while (first < padded_common + keys);

    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        float all = subgroupAdd(total[r]);
        uint query = first_query + r;
        uint at = ((sequence * queries + query) * heads + gl_WorkGroupID.y) * DIM + lane;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) {
            if (query < queries) result[at + c * gl_WorkGroupSize.x] = sum[r][c] / all;
        }
    }
}
