// Running softmax of a subgroup's scores, in matrices of sums. Weights are stored as factors.
//
// The includer declares `score`, `sums`, shared memory `staged` and, from `scratch` on, room for
// ROWS rows of TILE factors, WEIGHT_STRIDE apart, and for the strip of shared/across_rows.
//
// Loops around barriers stay short: long ones are not unrolled, which moves `sums` to local memory.
#include "shared/across_rows.glsl"

// A larger rise of a row's maximum rescales its sums; weights are at most exp(RISE).
const float RISE = 5.0;

Sums highest[REPEAT_M]; // per row, a score within RISE of its maximum so far
Sums total[REPEAT_M];   // of a row's weights, in parts

void softmax_begin() {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        highest[m] = Sums(LOWEST);
        total[m] = Sums(0);
    }
}

#if FACTOR_IS_F16
float rounded(float weight) { return float(float16_t(weight)); }
#else
float rounded(float weight) { return uintBitsToFloat(bf16_bits(vec4(weight)).x << 16); }
#endif

// Stores rounded weights of MATRIX_M queries.
void put_weights(uint m) {
    uint at = scratch + m * MATRIX_M * WEIGHT_STRIDE;
#if FACTOR_IS_F16
    [[unroll]] for (uint n = 0; n < KEYS; n++) {
        coopMatStore(Halves(score[m * KEYS + n]), staged, at + n * MATRIX_N / 8, WEIGHT_STRIDE, ROW_MAJOR);
    }
#else
    uint strip = scratch + STRIP;
    subgroupBarrier();
    [[unroll]] for (uint n = 0; n < KEYS; n++) {
        coopMatStore(score[m * KEYS + n], staged, strip + n * MATRIX_N / 4, STRIP_STRIDE, ROW_MAJOR);
    }
    subgroupBarrier();
    for (uint i = gl_SubgroupInvocationID; i < MATRIX_M * TILE / 8; i += LANES) {
        uint from = strip + i / (TILE / 8) * STRIP_STRIDE + i % (TILE / 8) * 2;
        vec4 w0 = uintBitsToFloat(staged[from]);
        vec4 w1 = uintBitsToFloat(staged[from + 1]);
        staged[at + i / (TILE / 8) * WEIGHT_STRIDE + i % (TILE / 8)] = uvec4(pack_FACTOR4(w0), pack_FACTOR4(w1));
    }
#endif
}

// Turns scores into weights.
void softmax() {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        row = score[m * KEYS];
        [[unroll]] for (uint n = 1; n < KEYS; n++) {
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) row[i] = max(row[i], score[m * KEYS + n][i]);
        }
        uint rises = 0;
        [[unroll]] for (uint i = 0; i < ELEMENTS; i++) rises += uint(row[i] - highest[m][i] > RISE);
        if (ALWAYS_RESCALE || subgroupAny(rises > 0)) {
            across_rows(false);
            float keep[ELEMENTS];
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) {
                float now = max(highest[m][i], row[i]);
                keep[i] = exp(highest[m][i] - now);
                highest[m][i] = now;
                total[m][i] *= keep[i];
            }
            [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
                [[unroll]] for (uint i = 0; i < ELEMENTS; i++) sums[m * BLOCKS + n][i] *= keep[i];
            }
        }
    }
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        [[unroll]] for (uint n = 0; n < KEYS; n++) {
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) {
                float weight = rounded(exp(score[m * KEYS + n][i] - highest[m][i]));
                score[m * KEYS + n][i] = weight;
                total[m][i] += weight;
            }
        }
        put_weights(m);
    }
}

// Divides sums by the totals.
void softmax_end() {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        row = total[m];
        across_rows(true);
        [[unroll]] for (uint i = 0; i < ELEMENTS; i++) total[m][i] = 1.0 / row[i];
    }
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        [[unroll]] for (uint n = 0; n < BLOCKS; n++) {
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) sums[m * BLOCKS + n][i] *= total[m][i];
        }
    }
}
