// Finds where each tile's intersections start.
//
// tiles [capacity], sorted, the first item_count[0] of them in use; tile_offsets [tile_count + 1].
// One invocation owns one tile and finds it by binary search.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Tiles { uint tiles[]; };
layout(set = 0, binding = 1) readonly buffer ItemCount { uint item_count[]; };
layout(set = 0, binding = 2) writeonly buffer TileOffsets { uint tile_offsets[]; };
layout(push_constant) uniform Push { uint tile_count; };

void main() {
    uint tile = global_index();
    if (tile > tile_count) return;
    uint from = 0, to = item_count[0];
    while (from < to) {
        uint middle = (from + to) / 2;
        if (tiles[middle] < tile) from = middle + 1;
        else to = middle;
    }
    tile_offsets[tile] = from;
}
