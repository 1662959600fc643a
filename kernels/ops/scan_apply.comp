// Replaces values by their exclusive prefix sums: second half of a scan.
//
// Values [count] u32, in place
// Sums   [blocks] u32, of ops/scan_reduce
//
// One workgroup owns one block of values and sums the blocks before it.
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
#include "shared/blocks.glsl"

layout(constant_id = 1) const uint ROUNDS = 1; // values per lane whose loads overlap

layout(set = 0, binding = 0) buffer Values { uint values[]; };
layout(set = 0, binding = 1) readonly buffer Sums { uint sums[]; };
layout(push_constant) uniform Push { uint count; uint blocks; };

void main() {
    uint base = 0;
    for (uint b = gl_SubgroupInvocationID; b < group_index(); b += gl_SubgroupSize) base += sums[b];
    base = subgroupAdd(base);
    uvec2 range = block_range(count, blocks);
    for (uint first = range.x; first < range.y; first += ROUNDS * gl_SubgroupSize) {
        uint own[ROUNDS];
        for (uint r = 0; r < ROUNDS; r++) {
            uint i = first + r * gl_SubgroupSize + gl_SubgroupInvocationID;
            own[r] = i < range.y ? values[i] : 0;
        }
        for (uint r = 0; r < ROUNDS; r++) {
            uint i = first + r * gl_SubgroupSize + gl_SubgroupInvocationID;
            uint before = base + subgroupExclusiveAdd(own[r]);
            if (i < range.y) values[i] = before;
            base += subgroupAdd(own[r]);
        }
    }
}
