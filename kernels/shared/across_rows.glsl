// Reduction of the rows of a matrix of sums by its subgroup, through shared memory `scratch`.
//
// The includer defines LANES, and a strip of MATRIX_M rows of f32, STRIP_STRIDE vectors apart, at
// `own` + STRIP.

Sums row;

// Several lanes share a row of MATRIX_N values.
const uint QUADS = MATRIX_N / 4;
const uint ROW_LANES = LANES <= MATRIX_M ? 1 : LANES / MATRIX_M < QUADS ? LANES / MATRIX_M : QUADS;
const uint LANE_QUADS = QUADS / ROW_LANES;

// Replaces the components of `row` by the largest of its row, or by its sum.
void across_rows(const bool add) {
    uint strip = own + STRIP;
    subgroupBarrier();
    coopMatStore(row, scratch, strip, STRIP_STRIDE, ROW_MAJOR);
    subgroupBarrier();
    for (uint i = 0; i < MATRIX_M; i += LANES / ROW_LANES) {
        uint lane_row = min(i + gl_SubgroupInvocationID / ROW_LANES, MATRIX_M - 1);
        uint at = strip + lane_row * STRIP_STRIDE + gl_SubgroupInvocationID % ROW_LANES * LANE_QUADS;
        float x = add ? 0.0 : LOWEST;
        [[unroll]] for (uint c = 0; c < LANE_QUADS; c++) {
            vec4 y = uintBitsToFloat(scratch[at + c]);
            x = add ? x + dot(y, vec4(1.0)) : max(x, max(max(y.x, y.y), max(y.z, y.w)));
        }
        [[unroll]] for (uint apart = 1; apart < ROW_LANES; apart *= 2) {
            float other = subgroupShuffleXor(x, apart);
            x = add ? x + other : max(x, other);
        }
        subgroupBarrier(); // surplus lanes share the last row
        [[unroll]] for (uint c = 0; c < LANE_QUADS; c++) scratch[at + c] = floatBitsToUint(vec4(x));
    }
    subgroupBarrier();
    coopMatLoad(row, scratch, strip, STRIP_STRIDE, ROW_MAJOR);
    subgroupBarrier();
}
