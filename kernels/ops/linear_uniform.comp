// Linear layer of ops/linear, bit-identical, with uniform loads for CPU drivers.
//
// Buffers as in ops/linear, f32, never SPLIT
//
// One subgroup owns TILE_ROWS rows and VECTORS columns a lane, adjacent columns in adjacent lanes.
// Surplus rows repeat the last. See shared/uniform.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_shuffle : require
#include "shared/gelu.glsl"
#include "shared/limits.glsl"

layout(local_size_x_id = 0) in;

#include "shared/uniform.glsl"

layout(constant_id = 1) const uint ACTIVATION = 0; // 0 none, 1 GELU (erf), 2 SwiGLU
layout(constant_id = 2) const bool SCALE = false;
layout(constant_id = 3) const bool ADD = false;
layout(constant_id = 4) const uint TERMS = 4; // per loop pass; divides inner, and Q8_GROUP if Q8
layout(constant_id = 5) const uint TILE_ROWS = 6;
layout(constant_id = 6) const uint VECTORS = 2; // VECTORS * subgroup size divides PANEL_COLUMNS
layout(constant_id = 7) const bool Q8 = false;

layout(set = 0, binding = 0) readonly buffer A { float a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Gamma { float gamma[]; };
layout(set = 0, binding = 4) readonly buffer Residual { float residual[]; };
layout(set = 0, binding = 5) buffer Out { float result[]; };
layout(set = 0, binding = 6) readonly buffer Integers { uint integers[]; };
layout(set = 0, binding = 7) readonly buffer Scales { uint scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
    uvec2 a_address;
    uvec2 weight_address;
    uvec2 integers_address;
    uvec2 scales_address;
};

uint64_t row_at[TILE_ROWS];
float sum[TILE_ROWS][VECTORS];

// Weight of term j in the lane's column v, from the integers at `at`.
float q8_at(uint64_t at, uint j, uint v, float scale) {
    uint word = shared_word_at(at, j / 4 * PANEL_COLUMNS + v * gl_WorkGroupSize.x + j % 4, 4, 4);
    return float(int(word << (24 - 8 * (lane % 4))) >> 24) * scale;
}

float scale_at(uint64_t at, uint v) {
    vec2 two = unpackHalf2x16(shared_word_at(at, v * gl_WorkGroupSize.x / 2, 2, 1));
    return lane % 2 == 0 ? two.x : two.y;
}

// Adds term j at `offset` bytes of each row; `weights` addresses weights, or integers if Q8.
void add_term(uint64_t offset, uint64_t weights, float scale[VECTORS], uint j) {
    float factor[VECTORS];
    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        factor[v] = Q8 ? q8_at(weights, j, v, scale[v]) : vector_at(weights, j * PANEL_COLUMNS + v * gl_WorkGroupSize.x);
    }
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        float x = Values(row_at[r] + offset).values[j];
        [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] += x * factor[v];
    }
}

void store(uint row, uint column, float value) {
    if (ACTIVATION == 1) value = gelu(value);
    if (SCALE) value *= gamma[column];
    uint at = row * columns + column;
    if (ADD) value += residual[at];
    result[at] = value;
}

void main() {
    find_lanes();
    uint first_row = gl_WorkGroupID.x * TILE_ROWS;
    uint first_column = gl_WorkGroupID.y * VECTORS * gl_WorkGroupSize.x;
    uint64_t before = first_column / PANEL_COLUMNS * inner * PANEL_COLUMNS;
    uint within = first_column % PANEL_COLUMNS;
    // A word has 4 columns, so 4 terms take PANEL_COLUMNS words.
    uint64_t weight_at = Q8 ? packUint2x32(integers_address) + before + 4 * within
                            : packUint2x32(weight_address) + 4 * (before + within);
    uint64_t scales_at = packUint2x32(scales_address) + 2 * (before / Q8_GROUP + within);
    [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
        row_at[r] = packUint2x32(a_address) + 4 * uint64_t(min(first_row + r, rows - 1) * inner);
        [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] = 0.0;
    }
    uint k = 0;
    do {
        uint64_t offset = 4 * uint64_t(k);
        float scale[VECTORS];
        [[unroll]] for (uint v = 0; v < VECTORS; v++) {
            scale[v] = Q8 ? scale_at(scales_at + k / Q8_GROUP * (2 * PANEL_COLUMNS), v) : 1.0;
        }
        uint64_t weights = weight_at + uint64_t(k) * PANEL_COLUMNS * (Q8 ? 1 : 4);
        [[unroll]] for (uint j = 0; j < TERMS; j++) add_term(offset, weights, scale, j);
        k += TERMS;
    } while (k < inner);

    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        uint column = first_column + v * gl_WorkGroupSize.x + lane;
        float offset = column < columns ? bias[column] : 0.0;
        [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
            uint row = first_row + r;
            float value = sum[r][v] + offset;
            if (ACTIVATION == 2) {
                float gated = silu(value) * subgroupShuffleXor(value, 1);
                if (row < rows && column < columns && column % 2 == 0) result[(row * columns + column) / 2] = gated;
            } else if (row < rows && column < columns) {
                store(row, column, value);
            }
        }
    }
}
