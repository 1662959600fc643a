// Counts the tiles of each pair of a Gaussian and a camera, in depth order.
//
// TileSets   [pairs, 3] u32, of render/project
// Indices    [pairs] u32, pairs from near to far
// TileCounts [pairs + 1] u32, 0 at the end
//
// One invocation owns one place in the depth order.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/index.glsl"
#include "shared/splat.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer TileSets { uvec3 tile_sets[]; };
layout(set = 0, binding = 1) readonly buffer Indices { uint indices[]; };
layout(set = 0, binding = 2) writeonly buffer TileCounts { uint tile_counts[]; };
layout(push_constant) uniform Push { uint pairs; };

void main() {
    uint rank = global_index();
    if (rank > pairs) return;
    tile_counts[rank] = rank < pairs ? tile_count(unpack(tile_sets[indices[rank]])) : 0;
}
