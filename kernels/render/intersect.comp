// Lists the intersections of Gaussians with tiles, in depth order.
//
// TileSets    [pairs, 3] u32, of render/project
// Indices     [pairs] u32, pairs from near to far
// Offsets     [pairs + 1] u32, prefix sums of render/tile_counts
// Tiles       [capacity] u32, tile of each intersection, camera-major, then row-major
// PairIndices [capacity] u32, pair of each intersection
// Status      [3] u32, 0 before: listed intersections, total modulo 2^32, whether the total wrapped
//
// One invocation owns one place in the depth order; the one past the last writes Status.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/index.glsl"
#include "shared/splat.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer TileSets { uvec3 tile_sets[]; };
layout(set = 0, binding = 1) readonly buffer Indices { uint indices[]; };
layout(set = 0, binding = 2) readonly buffer Offsets { uint offsets[]; };
layout(set = 0, binding = 3) writeonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = 4) writeonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 5) buffer Status { uint status[]; };
layout(push_constant) uniform Push { uint pairs; uint camera_count; uvec2 grid; uint capacity; };

void main() {
    uint rank = global_index();
    if (rank > pairs) return;
    uint place = offsets[rank];
    if (rank == pairs) {
        status[0] = min(place, capacity);
        status[1] = place;
        return;
    }
    uint end = offsets[rank + 1];
    if (end < place) atomicOr(status[2], 1);
    uint pair = indices[rank];
    TileSet set = unpack(tile_sets[pair]);
    uint corner = ((pair % camera_count) * grid.y + set.first.y) * grid.x + set.first.x;
    for (uint t = 0; place < min(end, capacity); place++) {
        if (set.mask != 0) {
            t = findLSB(set.mask);
            set.mask &= set.mask - 1;
        }
        tiles[place] = corner + t / set.size.x * grid.x + t % set.size.x;
        pair_indices[place] = pair;
        t++;
    }
}
