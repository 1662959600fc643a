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

// Stores the splats of the lanes inside that reach the workgroup, in order, and returns their
// number. A subgroup barrier must follow. `at` is the lane's place; BATCH if not stored.
uint put(Falloff falloff, vec4 shade, bool inside, out uint at) {
    bool reached = inside && reaches(falloff);
    uvec4 lanes = subgroupBallot(reached);
    at = reached ? subgroupBallotExclusiveBitCount(lanes) : BATCH;
    subgroupBarrier(); // orders reads of the last batch before writes
    if (reached) {
        corners[at] = vec4(falloff.corner, falloff.opacity);
        shapes[at] = vec4(falloff.conic, falloff.faint);
        if (COLOR || DEPTH) shades[at] = shade;
    }
    return subgroupBallotBitCount(lanes);
}

Falloff batch_falloff(uint at) {
    vec4 corner = corners[at], shape = shapes[at];
    return Falloff(corner.xyz, shape.xyz, corner.w, shape.w);
}

vec4 batch_shade(uint at) { return COLOR || DEPTH ? shades[at] : vec4(0); }
