// Slot of a pair's gradient or sum by this tile. Needs tile_sets, slots, splat and runs.
uint slot_of(uint pair) {
    TileSet set = unpack(tile_sets[pair]);
    uvec2 at = tile() - set.first;
    uint t = at.y * set.size.x + at.x;
    return slots[pair] + (set.mask != 0 ? bitCount(set.mask & (1u << t) - 1) : t);
}
