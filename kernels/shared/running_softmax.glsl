// Running softmax of a subgroup's scores, in matrices of sums. Unless CONVERTS, weights are stored
// as factors.
//
// The includer declares `score`, `sums`, and shared memory `scratch` with room, from `own` on, for
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

#if !CONVERTS
// Stores a group's weights of MATRIX_M queries.
void put_weights(uint m, uint group) {
    uint first = m * KEYS + group * GROUP / MATRIX_N;
    uint at = own + m * MATRIX_M * WEIGHT_STRIDE + group * GROUP / 8;
#if FACTOR_IS_F16
    [[unroll]] for (uint n = 0; n < GROUP / MATRIX_N; n++) {
        coopMatStore(Halves(score[first + n]), scratch, at + n * MATRIX_N / 8, WEIGHT_STRIDE, ROW_MAJOR);
    }
#else
    uint strip = own + STRIP;
    subgroupBarrier();
    [[unroll]] for (uint n = 0; n < GROUP / MATRIX_N; n++) {
        coopMatStore(score[first + n], scratch, strip + n * MATRIX_N / 4, STRIP_STRIDE, ROW_MAJOR);
    }
    subgroupBarrier();
    for (uint i = gl_SubgroupInvocationID; i < MATRIX_M * GROUP / 8; i += LANES) {
        uint from = strip + i / (GROUP / 8) * STRIP_STRIDE + i % (GROUP / 8) * 2;
        vec4 w0 = uintBitsToFloat(scratch[from]);
        vec4 w1 = uintBitsToFloat(scratch[from + 1]);
        scratch[at + i / (GROUP / 8) * WEIGHT_STRIDE + i % (GROUP / 8)] = uvec4(pack_FACTOR4(w0), pack_FACTOR4(w1));
    }
#endif
}
#endif

// Rescales the sums of rows whose maximum rose.
void rescale() {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        row = score[m * KEYS];
        [[unroll]] for (uint n = 1; n < KEYS; n++) {
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) row[i] = max(row[i], score[m * KEYS + n][i]);
        }
        uint rises = 0; // unlike a maximum, safe from NaN in surplus rows
        [[unroll]] for (uint i = 0; i < ELEMENTS; i++) rises += uint(row[i] - highest[m][i] > RISE);
        if (CPU || subgroupAny(rises > 0)) {
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
}

// Turns a group's scores into weights.
void weigh(uint group) {
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) {
        [[unroll]] for (uint n = group * GROUP / MATRIX_N; n < (group + 1) * GROUP / MATRIX_N; n++) {
            [[unroll]] for (uint i = 0; i < ELEMENTS; i++) {
                float weight = rounded(exp(score[m * KEYS + n][i] - highest[m][i]));
                score[m * KEYS + n][i] = weight;
                total[m][i] += weight;
            }
        }
    }
#if !CONVERTS
    [[unroll]] for (uint m = 0; m < REPEAT_M; m++) put_weights(m, group);
    subgroupBarrier();
#endif
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
