// Cooperative matrices in the device's sizes, after `#pragma factor`.
//
// Shared memory holds vectors (pieces) of 8 factors. Sums are f32, or i32 of i8 factors.
#pragma use_vulkan_memory_model
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_cooperative_matrix : require
#extension GL_KHR_memory_scope_semantics : require
#extension GL_KHR_shader_subgroup_basic : require

layout(constant_id = 1) const uint SUBGROUPS = 4;
layout(constant_id = 2) const uint MATRIX_M = 16;
layout(constant_id = 3) const uint MATRIX_N = 16;
layout(constant_id = 4) const uint MATRIX_K = 16;

#define Left coopmat<FACTOR_COMPONENT, gl_ScopeSubgroup, MATRIX_M, MATRIX_K, gl_MatrixUseA>
#define Right coopmat<FACTOR_COMPONENT, gl_ScopeSubgroup, MATRIX_K, MATRIX_N, gl_MatrixUseB>
#define Sums coopmat<FACTOR_SUM, gl_ScopeSubgroup, MATRIX_M, MATRIX_N, gl_MatrixUseAccumulator>
#if FACTOR_IS_F16
#define Halves coopmat<float16_t, gl_ScopeSubgroup, MATRIX_M, MATRIX_N, gl_MatrixUseAccumulator>
#endif
const int ROW_MAJOR = gl_CooperativeMatrixLayoutRowMajor;
const int COLUMN_MAJOR = gl_CooperativeMatrixLayoutColumnMajor;

#if FACTOR_IS_I8
#define Piece uvec2
#else
#define Piece uvec4
#endif
// Pieces per four sums.
const uint QUAD = 1 + FACTOR_IS_I8;
