// The pixels of a workgroup that draws a tile, or a part of one: RUNS runs, row-major, each as long as the workgroup. Needs RUNS
// and first_tile_row of the includer, and limits.

const uint LANES = gl_WorkGroupSize.x;
const float LOG2_E = 1.4426950408889634;
const float ROUNDING = 0.05; // of exponents, well above what it is in images of 2^15 pixels a side

// Where the first pixel of a run lies in its tile, and where an invocation's pixel lies from there.
uvec2 run_start(uint run) {
    const uint groups = TILE * TILE / (RUNS * LANES);
    uint p = (gl_WorkGroupID.x % groups * RUNS + run) * LANES;
    return uvec2(p % TILE, p / TILE);
}

uvec2 lane_offset() {
    uint lane = gl_LocalInvocationID.x;
    return LANES <= TILE ? uvec2(lane, 0) : uvec2(lane % TILE, lane / TILE);
}

uvec2 tile() { return uvec2(gl_WorkGroupID.x * RUNS * LANES / (TILE * TILE), first_tile_row + gl_WorkGroupID.y); }

uvec2 position(uint run) { return tile() * TILE + run_start(run) + lane_offset(); }
