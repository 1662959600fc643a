// A batch of splats in the shared memory of a one-subgroup workgroup.
//
// Needs BATCHED, COLOR and DEPTH of the includer, and runs. Unused arrays have length 1.
#extension GL_KHR_shader_subgroup_ballot : require

const uint BATCH = BATCHED ? LANES : 1;

shared vec4 corners[BATCH]; // and opacity
shared vec4 shapes[BATCH];  // conic and faint
shared vec4 shades[COLOR || DEPTH ? BATCH : 1]; // color and depth

// The test of `sees`, for all lanes and runs.
bool reaches(Falloff falloff) {
    bool reached = false;
    for (uint run = 0; run < RUNS; run++) {
        vec3 from = falloff.corner + run_start(run).xyy;
        for (uint row = 0; row < max(LANES / TILE, 1); row++) {
            reached = reached || strongest(falloff, from + vec3(0, row, row)) >= falloff.faint;
        }
    }
    return reached;
}

// Place of a lane's splat among the kept ones, and their count.
uint batch_place(bool kept, out uint count) {
    uvec4 lanes = subgroupBallot(kept);
    count = subgroupBallotBitCount(lanes);
    return subgroupBallotExclusiveBitCount(lanes);
}

void put(uint at, Falloff falloff, vec4 shade) {
    corners[at] = vec4(falloff.corner, falloff.opacity);
    shapes[at] = vec4(falloff.conic, falloff.faint);
    if (COLOR || DEPTH) shades[at] = shade;
}

Falloff batch_falloff(uint at) {
    vec4 corner = corners[at], shape = shapes[at];
    return Falloff(corner.xyz, shape.xyz, corner.w, shape.w);
}
