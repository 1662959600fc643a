// Softmax attention of one head over one sequence on matrix units.
//
// Q         [heads, sequences * queries, CHANNELS] FACTOR, scaled by 1 / sqrt(head size),
//           readable one workgroup past its end
// K, V      [heads, common_keys, CHANNELS] FACTOR, 0 past the head size; from row own_first on
//           [heads, sequences * keys, CHANNELS] of each sequence's own
// LogCounts [sequences, common_keys] f32, added to scores; read if POOLED, else common_keys is 0
// Out       [sequences * queries, heads * dim] FACTOR, saturated
//
// Weights go from sums to factors through shared memory.
#version 460
#pragma factor f16 bf16
#define CONVERTS 0
#include "shared/attention_matrix.glsl"
