// Counts each digit in each workgroup's block of keys: first part of a radix sort pass.
//
// Keys        [capacity] u32, the first item_count[0] in use
// ItemCount   [1] u32
// DigitCounts [256, blocks] u32
//
// One workgroup owns one block of keys and one column of DigitCounts.
#version 460
#extension GL_KHR_shader_subgroup_basic : require
layout(local_size_x_id = 0) in;
#include "shared/blocks.glsl"

layout(constant_id = 1) const uint ROUNDS = 1; // keys per lane whose loads overlap

layout(set = 0, binding = 0) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1) readonly buffer ItemCount { uint item_count[]; };
layout(set = 0, binding = 2) writeonly buffer DigitCounts { uint digit_counts[]; };
layout(push_constant) uniform Push { uint shift; uint mask; uint blocks; };

shared uint counts[RADIX];

void main() {
    for (uint d = gl_SubgroupInvocationID; d < RADIX; d += gl_SubgroupSize) counts[d] = 0;
    subgroupBarrier();
    uvec2 range = block_range(item_count[0], blocks);
    for (uint first = range.x; first < range.y; first += ROUNDS * gl_SubgroupSize) {
        uint own[ROUNDS];
        for (uint r = 0; r < ROUNDS; r++) {
            uint i = first + r * gl_SubgroupSize + gl_SubgroupInvocationID;
            if (i < range.y) own[r] = keys[i];
        }
        for (uint r = 0; r < ROUNDS; r++) {
            uint i = first + r * gl_SubgroupSize + gl_SubgroupInvocationID;
            if (i < range.y) atomicAdd(counts[own[r] >> shift & mask], 1);
        }
    }
    subgroupBarrier();
    for (uint d = gl_SubgroupInvocationID; d < RADIX; d += gl_SubgroupSize) {
        digit_counts[d * blocks + group_index()] = counts[d];
    }
}
