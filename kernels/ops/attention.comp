// Softmax attention of one head over one sequence, with a running maximum (FlashAttention, Dao et al. 2022).
//
// Q       [heads, sequences * queries, DIM] ELEMENT, already scaled by 1 / sqrt(DIM)
// K       [heads, sequences, DIM, padded keys] ELEMENT: keys run fastest, padded to a multiple of 4
// V       [heads, sequences * keys, DIM] ELEMENT
// Out     [sequences * queries, heads * DIM] ELEMENT
//
// One workgroup (a subgroup) owns ROWS queries of a head; each lane scores 4 keys at a time, then gathers 4 channels of
// the values (VECTORS times). Where a subgroup has more lanes than that takes, PARTS of it gather from different keys, and
// are added up in the end. Memory is linear in tokens.
#version 460
#pragma element ELEMENT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/limits.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const uint DIM = 64;
layout(constant_id = 2) const uint VECTORS = 2; // ceil(DIM / (4 * subgroup size))
layout(constant_id = 3) const uint PARTS = 1; // the power of two at or below 4 * subgroup size / DIM, at least 1

const uint ROWS = ATTENTION_ROWS;
const float LOWEST = -1e30; // finite, so that a difference of two maxima is never NaN

layout(set = 0, binding = 0) readonly buffer Q { ELEMENT4 q[]; };
layout(set = 0, binding = 1) readonly buffer K { ELEMENT4 k[]; };
layout(set = 0, binding = 2) readonly buffer V { ELEMENT4 v[]; };
layout(set = 0, binding = 3) writeonly buffer Out { ELEMENT4 result[]; };

layout(push_constant) uniform Push {
    uint queries;
    uint keys;
    uint sequences;
    uint heads;
};

shared vec4 weights[ROWS][gl_WorkGroupSize.x];

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint lanes = gl_WorkGroupSize.x;
    uint first_query = gl_WorkGroupID.x * ROWS;
    uint head = gl_WorkGroupID.y;
    uint sequence = gl_WorkGroupID.z;
    uint quads = DIM / 4;
    // Lanes past the last part repeat one, to keep the loop uniform.
    uint part = lane / quads % PARTS;
    uint first_channel = lane % quads;
    uint key_quads = (keys + 3) / 4;
    uint k_base = (head * sequences + sequence) * DIM * key_quads;
    uint v_base = (head * sequences + sequence) * keys * quads;

    uint q_at[ROWS];
    float highest[ROWS];
    float total[ROWS];
    vec4 sum[ROWS][VECTORS];
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        uint query = min(first_query + r, queries - 1);
        q_at[r] = ((head * sequences + sequence) * queries + query) * quads;
        highest[r] = LOWEST;
        total[r] = 0.0;
        [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] = vec4(0.0);
    }

    for (uint tile = 0; tile < key_quads; tile += lanes) {
        uint key_quad = tile + lane;
        uint k_at = k_base + min(key_quad, key_quads - 1);
        vec4 score[ROWS];
        [[unroll]] for (uint r = 0; r < ROWS; r++) score[r] = vec4(0.0);
        for (uint c = 0; c < quads; c++) {
            uint at = k_at + 4 * c * key_quads;
            vec4 k0 = from_ELEMENT4(k[at]);
            vec4 k1 = from_ELEMENT4(k[at + key_quads]);
            vec4 k2 = from_ELEMENT4(k[at + 2 * key_quads]);
            vec4 k3 = from_ELEMENT4(k[at + 3 * key_quads]);
            [[unroll]] for (uint r = 0; r < ROWS; r++) {
                vec4 x = from_ELEMENT4(q[q_at[r] + c]);
                score[r] += x.x * k0;
                score[r] += x.y * k1;
                score[r] += x.z * k2;
                score[r] += x.w * k3;
            }
        }
        // Keys past the end weigh nothing, whatever their padding holds.
        bvec4 real = lessThan(4 * key_quad + uvec4(0, 1, 2, 3), uvec4(keys));
        [[unroll]] for (uint r = 0; r < ROWS; r++) {
            vec4 s = mix(vec4(LOWEST), score[r], real);
            float tile_highest = subgroupMax(max(max(s.x, s.y), max(s.z, s.w)));
            float now = max(highest[r], tile_highest);
            float keep = exp(highest[r] - now);
            vec4 w = mix(vec4(0.0), exp(s - now), real);
            highest[r] = now;
            total[r] = total[r] * keep + w.x + w.y + w.z + w.w;
            [[unroll]] for (uint c = 0; c < VECTORS; c++) sum[r][c] *= keep;
            weights[r][lane] = w;
        }
        subgroupMemoryBarrierShared();
        subgroupBarrier();
        uint tile_quads = min(lanes, key_quads - tile);
        for (uint first = 0; first < tile_quads; first += PARTS) {
            // Past the end weights are 0.
            uint j = first + part;
            uint key = 4 * (tile + j);
            [[unroll]] for (uint c = 0; c < VECTORS; c++) {
                uint channel = min(first_channel + c * lanes, quads - 1);
                vec4 v0 = from_ELEMENT4(v[v_base + min(key, keys - 1) * quads + channel]);
                vec4 v1 = from_ELEMENT4(v[v_base + min(key + 1, keys - 1) * quads + channel]);
                vec4 v2 = from_ELEMENT4(v[v_base + min(key + 2, keys - 1) * quads + channel]);
                vec4 v3 = from_ELEMENT4(v[v_base + min(key + 3, keys - 1) * quads + channel]);
                [[unroll]] for (uint r = 0; r < ROWS; r++) {
                    vec4 w = weights[r][j];
                    sum[r][c] += w.x * v0;
                    sum[r][c] += w.y * v1;
                    sum[r][c] += w.z * v2;
                    sum[r][c] += w.w * v3;
                }
            }
        }
        subgroupBarrier();
    }

    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        float all = subgroupAdd(total[r]);
        uint query = first_query + r;
        if (query < queries) {
            [[unroll]] for (uint c = 0; c < VECTORS; c++) {
                vec4 whole = sum[r][c];
                for (uint apart = PARTS / 2; apart > 0; apart /= 2) {
                    whole += subgroupShuffle(whole, (lane + apart * quads) % lanes);
                }
                uint channel = lane + c * lanes;
                if (channel < quads) {
                    uint row = sequence * queries + query;
                    result[(row * heads + head) * quads + channel] = to_ELEMENT4(whole / all);
                }
            }
        }
    }
}
