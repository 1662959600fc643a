// Sums each workgroup's block of values: first half of a scan.
//
// Values [count] u32
// Sums   [blocks] u32
//
// One workgroup owns one block and waits for no other.
// Source: reduce-then-scan (Merrill and Grimshaw, Parallel Scan for Stream Architectures, 2009).
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
#include "shared/blocks.glsl"

layout(set = 0, binding = 0) readonly buffer Values { uint values[]; };
layout(set = 0, binding = 1) writeonly buffer Sums { uint sums[]; };
layout(push_constant) uniform Push { uint count; uint blocks; };

void main() {
    uvec2 range = block_range(count, blocks);
    uint sum = 0;
    for (uint i = range.x + gl_SubgroupInvocationID; i < range.y; i += gl_SubgroupSize) sum += values[i];
    sum = subgroupAdd(sum);
    if (subgroupElect()) sums[group_index()] = sum;
}
