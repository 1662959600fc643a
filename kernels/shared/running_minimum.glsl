// The least of every row of scores that come SUBGROUP_N columns at a time, and where it is, by the lanes of a workgroup.
//
// A subgroup has REPEAT_M times MATRIX_M rows. MATRIX_M of them at a time lie in shared memory `staged`, a strip of
// STRIP_STRIDE pieces each. The includer gives `vec4 scores_of(vec4 values, uint own, uint column)`, the scores of four values
// of the lane's own-th row, and `column_count`. NaN is never the least.

// Either several lanes share a row, or a lane has several.
const uint ROW_LANES = LANES > MATRIX_M ? LANES / MATRIX_M : 1;
const uint LANE_ROWS = (MATRIX_M + LANES - 1) / LANES;
const uint OWN_ROWS = REPEAT_M * LANE_ROWS;
const uint QUADS = SUBGROUP_N / 4;
const uint STRIP_STRIDE = QUADS + 1;
// Lanes of a workgroup that have some of a row.
const uint PARTS = SUBGROUPS_N * ROW_LANES;

vec4 scores_of(vec4 values, uint own, uint column);

float least[OWN_ROWS];
uint place[OWN_ROWS];

// The row of the subgroup that is the lane's own-th; some lanes may have one beyond the last of a strip.
uint row_in_strip(uint own) { return own % LANE_ROWS * LANES + gl_SubgroupInvocationID / ROW_LANES; }
uint row_in_subgroup(uint own) { return own / LANE_ROWS * MATRIX_M + row_in_strip(own); }

void minimum_begin() {
    [[unroll]] for (uint own = 0; own < OWN_ROWS; own++) {
        least[own] = uintBitsToFloat(0x7f800000u);
        place[own] = 0;
    }
}

// Takes the m-th strip, whose columns are those from `first_column` on. A lane's columns rise, so "less" keeps the first of
// equal ones.
void minimum(uint strip, uint m, uint first_column) {
    [[unroll]] for (uint i = 0; i < LANE_ROWS; i++) {
        uint own = m * LANE_ROWS + i;
        uint row = strip + min(row_in_strip(own), MATRIX_M - 1) * STRIP_STRIDE;
        for (uint quad = gl_SubgroupInvocationID % ROW_LANES; quad < QUADS; quad += ROW_LANES) {
            uint column = first_column + 4 * quad;
            if (column >= column_count) {
                break;
            }
            vec4 scores = scores_of(uintBitsToFloat(staged[row + quad]), own, column);
            [[unroll]] for (uint c = 0; c < 4; c++) {
                if (scores[c] < least[own] && column + c < column_count) {
                    least[own] = scores[c];
                    place[own] = column + c;
                }
            }
        }
    }
}

// Leaves what the lane has of its rows in shared memory, PARTS of every row of the workgroup.
void minimum_end(uint own_row, uint subgroup_column) {
    uint part = subgroup_column * ROW_LANES + gl_SubgroupInvocationID % ROW_LANES;
    [[unroll]] for (uint own = 0; own < OWN_ROWS; own++) {
        if (row_in_strip(own) < MATRIX_M) {
            uint at = (own_row + row_in_subgroup(own)) * PARTS + part;
            staged[at] = Piece(floatBitsToUint(least[own]), place[own], 0, 0);
        }
    }
}

// The least of a row, as bits, and where it is, of equal ones the first; after minimum_end and a barrier.
uvec2 minimum_of(uint row) {
    uvec2 found = staged[row * PARTS].xy;
    [[unroll]] for (uint part = 1; part < PARTS; part++) {
        uvec2 other = staged[row * PARTS + part].xy;
        float here = uintBitsToFloat(found.x), there = uintBitsToFloat(other.x);
        found = there < here || (there == here && other.y < found.y) ? other : found;
    }
    return found;
}
