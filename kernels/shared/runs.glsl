// Pixels of a workgroup within a tile, and their view of a splat.
//
// A workgroup owns RUNS row-major runs of pixels, each as long as itself. Needs RUNS, size and
// first_tile_row of the includer, limits and splat.

const uint LANES = gl_WorkGroupSize.x;
const float LOG2_E = 1.4426950408889634;
const float ROUNDING = 0.05; // above the rounding of exponents in images of 2^15 pixels a side

// First pixel of a run in its tile; lane_offset is relative to it.
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

struct Falloff {
    // Offset of the tile's first pixel from the splat's place; z: its y from ridge_row.
    vec3 corner;
    vec3 conic; // alpha = opacity 2^(A (dx - k dy)^2 + P dy^2)
    float opacity;
    float faint; // exponent where alpha is ALPHA_MIN
};

Falloff falloff(vec3 xy_opacity, vec3 conic) {
    vec2 place = xy_opacity.xy, first = vec2(tile() * TILE) + 0.5;
    vec3 corner = vec3(first - place, first.y - ridge_row(place.y, size.y));
    float faint = log2(ALPHA_MIN / xy_opacity.z) - ROUNDING;
    return Falloff(corner, conic * vec3(-0.5 * LOG2_E, 1, -0.5 * LOG2_E), xy_opacity.z, faint);
}

// A splat at a pixel: e = dx - k dy, y = dy, and the row's part of the exponent.
struct Sight {
    float e;
    float y;
    float across;
};

// Largest exponent in a run's row. `from` is its first pixel, as Falloff.corner.
float strongest(Falloff falloff, vec3 from) {
    float shear = falloff.conic.y * from.z;
    float nearest = clamp(shear, from.x, from.x + min(LANES, TILE) - 1) - shear;
    return falloff.conic.x * nearest * nearest + falloff.conic.z * from.y * from.y;
}

bool sees(Falloff falloff, uint run, out Sight sight) {
    vec3 from = falloff.corner + run_start(run).xyy + vec3(0, lane_offset().yy);
    float shear = falloff.conic.y * from.z;
    sight = Sight(from.x + lane_offset().x - shear, from.y, falloff.conic.z * from.y * from.y);
    return strongest(falloff, from) >= falloff.faint;
}

// Not clamped to ALPHA_MAX.
float alpha(Falloff falloff, Sight sight) {
    return falloff.opacity * exp2(falloff.conic.x * sight.e * sight.e + sight.across);
}
