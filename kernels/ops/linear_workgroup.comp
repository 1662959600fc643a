// Linear layer with its epilogue on matrices of a whole workgroup (VK_NV_cooperative_matrix2), which the driver stages:
// out = residual + gamma * activation(a * weight + bias).
//
// A         [rows, inner] f16
// Weight    [columns, inner] f16 (SwiGLU: gate and value alternate)
// Bias      [columns] f32
// Gamma     [columns] f32, LayerScale; read where SCALE
// Residual  [rows, columns] f32; read where ADD; may be Out itself
// Out       [rows, columns] OUTPUT, half as many columns after SwiGLU; f16 saturates
//
// One workgroup owns TILE_M rows of TILE_N columns of the result. Sums are f32.
#version 460
#pragma use_vulkan_memory_model
#pragma factor f16
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_NV_cooperative_matrix2 : require
#include "shared/gelu.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const uint SUBGROUPS = 8;
layout(constant_id = 2) const uint TILE_M = 128;
layout(constant_id = 3) const uint TILE_N = 128;
layout(constant_id = 4) const uint TILE_K = 64;
layout(constant_id = 5) const uint ACTIVATION = 0; // 0 none, 1 GELU (erf), 2 SwiGLU
layout(constant_id = 6) const bool SCALE = false;
layout(constant_id = 7) const bool ADD = false;

const uint MERGED = ACTIVATION == 2 ? 2 : 1; // columns that become one of the result

layout(set = 0, binding = 0) readonly buffer A { float16_t a[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float16_t weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Gamma { float gamma[]; };
layout(set = 0, binding = 4) readonly buffer Residual { float residual[]; };
layout(set = 0, binding = 5) buffer Out { OUTPUT result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint inner;
    uint columns;
};

#define Sums coopmat<float, gl_ScopeWorkgroup, TILE_M, TILE_N, gl_MatrixUseAccumulator>
// What lies outside a tensor is read as zero and not written.
#define Tensor tensorLayoutNV<2, gl_CooperativeMatrixClampModeConstantNV>

// The result's element of a tile at (row, column), whose sum is x.
float finish(const in uint row, const in uint column, const in float x, const in uint first_row, const in uint first_column) {
    uint c = min(first_column + column, columns - 1);
    float v = x + bias[c];
    if (ACTIVATION == 1) {
        v = gelu(v);
    }
    if (SCALE) {
        v *= gamma[c];
    }
    if (ADD && first_row + row < rows) {
        v += residual[(first_row + row) * columns + c];
    }
    return v;
}

// Gates and values of SwiGLU, whose columns alternate.
float gate(const in uint row, const in uint column, const in float x, const in uint first_column) {
    return silu(x + bias[min(2 * (first_column + column), columns - 2)]);
}

float value(const in uint row, const in uint column, const in float x, const in uint first_column) {
    return x + bias[min(2 * (first_column + column), columns - 2) + 1];
}

float saturated(const in uint row, const in uint column, const in float x) { return float(to_OUTPUT(x)); }

void main() {
    uint first_row = gl_WorkGroupID.y * TILE_M;
    uint first_column = gl_WorkGroupID.x * TILE_N;
    Tensor left = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    left = setTensorLayoutDimensionNV(left, rows, inner);
    Tensor right = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    right = setTensorLayoutDimensionNV(right, columns / MERGED, inner);
    right = setTensorLayoutStrideNV(right, MERGED * inner, 1);
    tensorViewNV<2, false, 1, 0> transposed = createTensorViewNV(2, false, 1, 0);

    Sums sums = Sums(0.0);
    Sums values = Sums(0.0);
    for (uint k = 0; k < inner; k += TILE_K) {
        coopmat<float16_t, gl_ScopeWorkgroup, TILE_M, TILE_K, gl_MatrixUseA> x;
        coopmat<float16_t, gl_ScopeWorkgroup, TILE_K, TILE_N, gl_MatrixUseB> w;
        Tensor columns_of_tile = sliceTensorLayoutNV(right, first_column, TILE_N, k, TILE_K);
        coopMatLoadTensorNV(x, a, 0, sliceTensorLayoutNV(left, first_row, TILE_M, k, TILE_K));
        coopMatLoadTensorNV(w, weight, 0, columns_of_tile, transposed);
        sums = coopMatMulAdd(x, w, sums);
        if (ACTIVATION == 2) {
            coopMatLoadTensorNV(w, weight, inner, columns_of_tile, transposed);
            values = coopMatMulAdd(x, w, values);
        }
    }

    if (ACTIVATION == 2) {
        coopMatPerElementNV(sums, sums, gate, first_column);
        coopMatPerElementNV(values, values, value, first_column);
        sums = sums * values;
    } else {
        coopMatPerElementNV(sums, sums, finish, first_row, first_column);
    }
    coopMatPerElementNV(sums, sums, saturated);
    Tensor written = createTensorLayoutNV(2, gl_CooperativeMatrixClampModeConstantNV);
    written = setTensorLayoutDimensionNV(written, rows, columns / MERGED);
    written = sliceTensorLayoutNV(written, first_row, TILE_M, first_column, TILE_N);
    coopMatStoreTensorNV(coopmat<OUTPUT, gl_ScopeWorkgroup, TILE_M, TILE_N, gl_MatrixUseAccumulator>(sums), result, 0, written);
}
