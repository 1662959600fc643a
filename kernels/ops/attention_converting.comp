// As ops/attention_matrix, with weights that go from sums to factors in registers.
#version 460
#pragma factor f16 bf16
#extension GL_NV_cooperative_matrix2 : require
#define CONVERTS 1
#include "shared/attention_matrix.glsl"
