// Running softmax of rows of scores, TILE at a time, by one subgroup.
//
// A row of shared memory `staged` has TILE f32 scores, replaced by FACTOR weights in its first
// half. MATRIX_N copies of the factor that rescales earlier sums follow them. If POOLED, the
// includer's `more` is added to scores.
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/numbers.glsl"

// Several lanes share a row, or a lane owns several.
const uint ROW_LANES = LANES > ROWS ? LANES / ROWS : 1;
const uint LANE_ROWS = ROWS > LANES ? ROWS / LANES : 1;
const uint LANE_QUADS = TILE / 4 / ROW_LANES;
const uint RESCALE = TILE / 8;

float highest[LANE_ROWS];
float total[LANE_ROWS];

void softmax_begin() {
    [[unroll]] for (uint i = 0; i < LANE_ROWS; i++) {
        highest[i] = LOWEST;
        total[i] = 0.0;
    }
}

uint lane_row(uint i) { return i * LANES + gl_SubgroupInvocationID / ROW_LANES; }

void put_factor(uint row, float factor) {
    [[unroll]] for (uint c = 0; c < MATRIX_N / 4; c++) staged[row + RESCALE + c] = floatBitsToUint(vec4(factor));
}

// Turns scores into weights; returns whether earlier sums must be rescaled.
bool softmax(uint scores, uint first_key, uint keys) {
    uint part = gl_SubgroupInvocationID % ROW_LANES * LANE_QUADS;
    bool changed = false;
    [[unroll]] for (uint i = 0; i < LANE_ROWS; i++) {
        uint row = scores + lane_row(i) * SCORE_STRIDE;
        vec4 s[LANE_QUADS];
        float now = highest[i];
        [[unroll]] for (uint c = 0; c < LANE_QUADS; c++) {
            s[c] = uintBitsToFloat(staged[row + part + c]);
            if (POOLED) s[c] += more(first_key + 4 * (part + c));
            if (first_key + TILE > keys) {
                uint key = first_key + 4 * (part + c);
                s[c] = mix(vec4(LOWEST), s[c], lessThan(key + uvec4(0, 1, 2, 3), uvec4(keys)));
            }
            now = max(now, max(max(s[c].x, s[c].y), max(s[c].z, s[c].w)));
        }
        [[unroll]] for (uint apart = 1; apart < ROW_LANES; apart *= 2) now = max(now, subgroupShuffleXor(now, apart));
        float keep = exp(highest[i] - now);
        changed = changed || now > highest[i];
        highest[i] = now;
        total[i] *= keep;
        if (ROW_LANES > 1) {
            subgroupBarrier(); // weights overwrite scores that other lanes read
        }
        [[unroll]] for (uint c = 0; c < LANE_QUADS; c += 2) {
            vec4 w0 = exp(s[c] - now);
            vec4 w1 = exp(s[c + 1] - now);
            total[i] += dot(w0 + w1, vec4(1.0));
            staged[row + (part + c) / 2] = uvec4(pack_FACTOR4(w0), pack_FACTOR4(w1));
        }
        put_factor(row, keep);
    }
    return changed;
}

void softmax_end(uint scores) {
    [[unroll]] for (uint i = 0; i < LANE_ROWS; i++) {
        [[unroll]] for (uint apart = 1; apart < ROW_LANES; apart *= 2) total[i] += subgroupShuffleXor(total[i], apart);
        put_factor(scores + lane_row(i) * SCORE_STRIDE, 1.0 / total[i]);
    }
}
