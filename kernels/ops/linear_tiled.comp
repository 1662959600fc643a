// Linear layer of ops/linear, bit-identical, with both factors in shared memory.
//
// Buffers as in ops/linear
//
// One workgroup owns TILE_ROWS x TILE_COLUMNS sums, and `share` terms if SPLIT; a lane LANE_ROWS x
// LANE_COLUMNS, interleaved. Shared memory stages TILE_K terms as f32 while the next ones load.
#version 460
#pragma element INPUT
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/epilogue.glsl"
#include "shared/limits.glsl"
#include "shared/q8.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 4) const bool Q8 = false;
layout(constant_id = 5) const uint SUBGROUPS = 1;
layout(constant_id = 6) const uint TILE_COLUMNS = 32;
layout(constant_id = 7) const uint LANE_ROWS = 4;
layout(constant_id = 8) const uint LANE_COLUMNS = 4; // a multiple of 4
layout(constant_id = 9) const uint TILE_K = 8;       // a multiple of 4
layout(constant_id = 10) const bool SPLIT = false;

const uint LANES = gl_WorkGroupSize.x;
const uint LANE_QUADS = LANE_COLUMNS / 4;
const uint TILE_QUADS = TILE_COLUMNS / 4;
const uint COLUMN_LANES = TILE_COLUMNS / LANE_COLUMNS;
const uint ROW_LANES = LANES / COLUMN_LANES;
const uint TILE_ROWS = ROW_LANES * LANE_ROWS;
const uint PANEL_QUADS = PANEL_COLUMNS / 4;
// A vec4 of padding per row avoids bank conflicts.
const uint A_QUADS = TILE_K / 4;
const uint A_STRIDE = A_QUADS + 1;
const uint STAGED_A = TILE_ROWS * A_STRIDE;
const uint A_LOADS = (TILE_ROWS * A_QUADS + LANES - 1) / LANES;
const uint W_LOADS = (TILE_K * TILE_QUADS + LANES - 1) / LANES;

layout(set = 0, binding = 0) readonly buffer A { INPUT4 a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { INPUT4 weight[]; };
layout(set = 0, binding = 6) readonly buffer Integers { uvec4 integers[]; };
layout(set = 0, binding = 7) readonly buffer Scales { uvec2 scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
    uint share;
};

shared vec4 staged[STAGED_A + TILE_K * TILE_QUADS];

vec4 next_a[A_LOADS];
uvec3 next_integers[W_LOADS];
vec4 next_weight[W_LOADS];

// Surplus rows and columns repeat the last; terms past `end` are 0.
void load(uint first_row, uint first_quad, uint first, uint end) {
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        uint k = first + at % A_QUADS * 4;
        uint row = min(first_row + at / A_QUADS, rows - 1);
        next_a[i] = k < end ? from_INPUT4(a[(row * inner + k) / 4]) : vec4(0.0);
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        uint k = first + at / TILE_QUADS;
        uint quad = min(first_quad + at % TILE_QUADS, (columns - 1) / 4);
        uint panel = quad / PANEL_QUADS;
        uint within = quad % PANEL_QUADS;
        if (Q8) {
            uint four = (panel * (inner / 4) + k / 4) * PANEL_QUADS + within;
            uint group = (panel * (inner / Q8_GROUP) + k / Q8_GROUP) * PANEL_QUADS + within;
            next_integers[i] = k < end ? uvec3(integers[four][k % 4], scales[group]) : uvec3(0);
        } else {
            next_weight[i] = k < end ? from_INPUT4(weight[(panel * inner + k) * PANEL_QUADS + within]) : vec4(0.0);
        }
    }
}

void stage() {
    [[unroll]] for (uint i = 0; i < A_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        if (at < TILE_ROWS * A_QUADS) staged[at / A_QUADS * A_STRIDE + at % A_QUADS] = next_a[i];
    }
    [[unroll]] for (uint i = 0; i < W_LOADS; i++) {
        uint at = i * LANES + gl_LocalInvocationID.x;
        vec4 four = Q8 ? q8_integers(next_integers[i].x) * q8_scales(next_integers[i].yz) : next_weight[i];
        if (at < TILE_K * TILE_QUADS) staged[STAGED_A + at] = four;
    }
}

void main() {
    uint first_row = gl_WorkGroupID.y * TILE_ROWS;
    uint first_quad = gl_WorkGroupID.x * TILE_QUADS;
    uint own_row = gl_LocalInvocationID.x / COLUMN_LANES;
    uint own_quad = gl_LocalInvocationID.x % COLUMN_LANES;
    uint first = SPLIT ? gl_WorkGroupID.z * share : 0;
    uint end = SPLIT ? min(first + share, inner) : inner;

    vec4 sum[LANE_ROWS][LANE_QUADS];
    [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
        [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) sum[r][q] = vec4(0.0);
    }
    load(first_row, first_quad, first, end);
    stage();
    barrier();
    for (uint tile = first; tile < end; tile += TILE_K) {
        bool more = tile + TILE_K < end;
        if (more) load(first_row, first_quad, tile + TILE_K, end);
        [[unroll]] for (uint k = 0; k < A_QUADS; k++) {
            vec4 b[4][LANE_QUADS];
            [[unroll]] for (uint j = 0; j < 4; j++) {
                uint at = STAGED_A + (4 * k + j) * TILE_QUADS + own_quad;
                [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) b[j][q] = staged[at + q * COLUMN_LANES];
            }
            [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
                vec4 x = staged[(own_row + r * ROW_LANES) * A_STRIDE + k];
                [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) {
                    sum[r][q] += x.x * b[0][q];
                    sum[r][q] += x.y * b[1][q];
                    sum[r][q] += x.z * b[2][q];
                    sum[r][q] += x.w * b[3][q];
                }
            }
        }
        barrier();
        if (more) stage();
        barrier();
    }

    uint above = SPLIT ? gl_WorkGroupID.z * rows : 0;
    [[unroll]] for (uint q = 0; q < LANE_QUADS; q++) {
        uint quad = first_quad + own_quad + q * COLUMN_LANES;
        if (4 * quad >= columns) continue;
        vec4 offset = SPLIT ? vec4(0.0) : bias_of(quad, columns);
        [[unroll]] for (uint r = 0; r < LANE_ROWS; r++) {
            uint row = first_row + own_row + r * ROW_LANES;
            if (row < rows) finish(sum[r][q] + offset, above + row, quad, columns);
        }
    }
}
