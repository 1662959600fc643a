// Multiplies matrices in registers, to measure matrix throughput: sums += a * b.
//
// A   [2, MATRIX_M, MATRIX_K] FACTOR, starting with the first
// B   [PRODUCTS, MATRIX_K, MATRIX_N] FACTOR
// Out [subgroups, MATRIX_M, MATRIX_N] f32, i32 if FACTOR is i8: sum of all products
//
// All subgroups compute the same PRODUCTS independent sums. Bit i % 32 of `swaps` exchanges A's
// matrices after iteration i, so that no product leaves the loop.
#version 460
#pragma factor f16 bf16 i8
#extension GL_GOOGLE_include_directive : require
#include "shared/matrices.glsl"
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 5) const uint PRODUCTS = 8;

layout(set = 0, binding = 0) readonly buffer A { Piece a[]; };
layout(set = 0, binding = 1) readonly buffer B { Piece b[]; };
layout(set = 0, binding = 2) writeonly buffer Out { FACTOR_SUM result[]; };

layout(push_constant) uniform Push {
    uint iterations;
    uint swaps;
};

void main() {
    Left left, other;
    coopMatLoad(left, a, 0, MATRIX_K / 8, ROW_MAJOR);
    coopMatLoad(other, a, MATRIX_M * MATRIX_K / 8, MATRIX_K / 8, ROW_MAJOR);
    Right right[PRODUCTS];
    Sums sums[PRODUCTS];
    [[unroll]] for (uint p = 0; p < PRODUCTS; p++) {
        coopMatLoad(right[p], b, p * MATRIX_K * MATRIX_N / 8, MATRIX_N / 8, ROW_MAJOR);
        sums[p] = Sums(0);
    }
    for (uint i = 0; i < iterations; i++) {
        [[unroll]] for (uint p = 0; p < PRODUCTS; p++) sums[p] = coopMatMulAdd(left, right[p], sums[p]);
        if ((swaps >> i % 32 & 1u) != 0) {
            Left before = left;
            left = other;
            other = before;
        }
    }
    [[unroll]] for (uint p = 1; p < PRODUCTS; p++) sums[0] += sums[p];
    uint subgroup = group_index() * SUBGROUPS + gl_SubgroupID;
    coopMatStore(sums[0], result, subgroup * MATRIX_M * MATRIX_N, MATRIX_N, ROW_MAJOR);
}
