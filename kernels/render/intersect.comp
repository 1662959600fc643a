// Lists every intersection of a Gaussian with a tile, in depth order.
//
// tile_sets [pairs, 3]; indices [pairs] of pairs, near to far; offsets [pairs + 1], the prefix sum of tile_counts;
// tiles, pair_indices [capacity] of each intersection: tile id (camera-major, then row-major) and index of the pair.
// status [3]: intersections that were listed, those that there are modulo 2^32, and whether that number wrapped.
// One invocation owns one place in the depth order; the one past the last writes status, which is 0 before.
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
