// The two least distinct scores of each row and their first columns, SUBGROUP_N columns at a time.
//
// Shared memory `staged` holds a strip of MATRIX_M rows, STRIP_STRIDE pieces each. The includer
// defines `scores_of` and `column_count`. A result is (bits of the least, its column, bits of the
// second, its column). NaN never counts; infinity means none.

#include "shared/numbers.glsl"

// Several lanes share a row, or a lane owns several.
const uint ROW_LANES = LANES > MATRIX_M ? LANES / MATRIX_M : 1;
const uint LANE_ROWS = (MATRIX_M + LANES - 1) / LANES;
const uint OWN_ROWS = REPEAT_M * LANE_ROWS;
const uint QUADS = SUBGROUP_N / 4;
const uint STRIP_STRIDE = QUADS + 1;
const uint PARTS = SUBGROUPS_N * ROW_LANES;

vec4 scores_of(vec4 values, uint own, uint column);

uvec4 two_least[OWN_ROWS];

const uvec4 NONE = uvec4(INFINITY_BITS, 0, INFINITY_BITS, 0);

// Inserts a score; columns come in any order.
uvec4 with_score(uvec4 found, float score, uint column) {
    float least = uintBitsToFloat(found.x), second = uintBitsToFloat(found.z);
    uvec2 taken = uvec2(floatBitsToUint(score), column);
    if (score < least) return uvec4(taken, found.xy);
    if (score == least) return uvec4(found.x, min(found.y, column), found.zw);
    if (score < second) return uvec4(found.xy, taken);
    return score == second ? uvec4(found.xyz, min(found.w, column)) : found;
}

// The lane's own-th row of the subgroup, possibly past a strip's end.
uint row_in_strip(uint own) { return own % LANE_ROWS * LANES + gl_SubgroupInvocationID / ROW_LANES; }
uint row_in_subgroup(uint own) { return own / LANE_ROWS * MATRIX_M + row_in_strip(own); }

void minimum_begin() {
    [[unroll]] for (uint own = 0; own < OWN_ROWS; own++) two_least[own] = NONE;
}

void minimum(uint strip, uint m, uint first_column) {
    [[unroll]] for (uint i = 0; i < LANE_ROWS; i++) {
        uint own = m * LANE_ROWS + i;
        uint row = strip + min(row_in_strip(own), MATRIX_M - 1) * STRIP_STRIDE;
        for (uint quad = gl_SubgroupInvocationID % ROW_LANES; quad < QUADS; quad += ROW_LANES) {
            uint column = first_column + 4 * quad;
            if (column >= column_count) break;
            vec4 scores = scores_of(uintBitsToFloat(staged[row + quad]), own, column);
            [[unroll]] for (uint c = 0; c < 4; c++) {
                if (scores[c] < uintBitsToFloat(two_least[own].z) && column + c < column_count) {
                    two_least[own] = with_score(two_least[own], scores[c], column + c);
                }
            }
        }
    }
}

// Stores the lane's results, PARTS per row.
void minimum_end(uint own_row, uint subgroup_column) {
    uint part = subgroup_column * ROW_LANES + gl_SubgroupInvocationID % ROW_LANES;
    [[unroll]] for (uint own = 0; own < OWN_ROWS; own++) {
        if (row_in_strip(own) < MATRIX_M) {
            uint at = (own_row + row_in_subgroup(own)) * PARTS + part;
            staged[at] = Piece(two_least[own]);
        }
    }
}

// Result of a row, after minimum_end and a barrier.
uvec4 minimum_of(uint row) {
    uvec4 found = staged[row * PARTS];
    [[unroll]] for (uint part = 1; part < PARTS; part++) {
        uvec4 other = staged[row * PARTS + part];
        found = with_score(found, uintBitsToFloat(other.x), other.y);
        found = with_score(found, uintBitsToFloat(other.z), other.w);
    }
    return found;
}
