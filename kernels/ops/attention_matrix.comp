// Softmax attention of one head over one sequence on matrix units.
//
// Q         [heads, sequences * queries, CHANNELS] FACTOR, scaled by 1 / sqrt(head size),
//           readable one workgroup past its end
// K, V      [heads, sequences * keys, CHANNELS] FACTOR, 0 past the head size
// LogCounts [sequences * keys] f32, log of the number of pooled patches; read if POOLED
// Out       [sequences * queries, heads * dim] FACTOR, saturated
//
// Weights go from sums to factors through shared memory.
#version 460
#pragma factor f16 bf16
#define CONVERTS 0
#include "shared/attention_matrix.glsl"
