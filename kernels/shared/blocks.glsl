// Blocks of n items, one per one-subgroup workgroup.
#extension GL_KHR_shader_subgroup_basic : require
#include "shared/index.glsl"

// First item and one past the last. Blocks start on whole subgroups, for aligned loads.
uvec2 block_range(uint n, uint blocks) {
    uint share = (n + blocks - 1) / blocks;
    share = (share + gl_SubgroupSize - 1) / gl_SubgroupSize * gl_SubgroupSize;
    uint first = min(group_index() * share, n);
    return uvec2(first, min(first + share, n));
}
