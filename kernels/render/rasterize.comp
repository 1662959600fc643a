// Blends the Gaussians of each tile front to back.
//
// PairIndices [intersections] u32, by tile, near to far
// TileOffsets [tiles + 1] u32
// XyOpacities, Conics, Colors, Depths [pairs, 3 or 1] f32, of render/project
// Normals     [pairs, 3] f32, of render/normals
// Frames      [C, rows, width, channels] f32: RGB, alpha, depth, normal, token RGB, as enabled
//
// Disabled outputs bind placeholders. Depth is the weighted sum of z, divided by alpha if
// EXPECTED_DEPTH. Normals are weighted sums scaled to length 1, or 0.
// One workgroup owns RUNS row-major runs of pixels of one tile, each as long as a subgroup. One
// invocation owns one pixel per run. All read a Gaussian at one address. If BATCHED, each lane
// loads one Gaussian of a batch into shared memory, which hides the latency of GPU memory.
// Source: 3D Gaussian Splatting (Kerbl et al. 2023) with the constants of gsplat 1.5.3.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_vote : require
layout(local_size_x_id = 0) in;
#include "shared/limits.glsl"
#include "shared/splat.glsl"

layout(constant_id = 1) const uint RUNS = 8;
layout(constant_id = 2) const bool COLOR = true;
layout(constant_id = 3) const bool HAS_BACKGROUND = false;
layout(constant_id = 4) const bool ALPHA = false;
layout(constant_id = 5) const bool DEPTH = false;
layout(constant_id = 6) const bool EXPECTED_DEPTH = false;
layout(constant_id = 7) const bool NORMAL = false;
layout(constant_id = 8) const uint TOKEN_PAIRS = 0; // pairs per token; 0 disables token colors
layout(constant_id = 9) const bool BATCHED = false;

layout(set = 0, binding = 0) readonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 1) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 3) readonly buffer Conics { vec3 conics[]; };
layout(scalar, set = 0, binding = 4) readonly buffer Colors { vec3 colors[]; };
layout(set = 0, binding = 5) readonly buffer Depths { float depths[]; };
layout(scalar, set = 0, binding = 6) readonly buffer Normals { vec3 normals[]; };
layout(set = 0, binding = 7) writeonly buffer Frames { float frames[]; };
layout(push_constant) uniform Push { uvec2 size; uvec2 grid; uint first_tile_row; uint row_count; vec3 background; };

#include "shared/runs.glsl"
#include "shared/batch.glsl"
#include "shared/token_color.glsl"

struct Values {
    vec3 rgb;
    float depth;
    vec3 normal;
    vec3 token;
};
const Values NOTHING = Values(vec3(0), 0, vec3(0), vec3(0));

struct Pixel {
    float transmittance; // negative once done
    Values sum;
};

struct Splat {
    vec3 xy_opacity;
    vec3 conic;
    Values values;
};

const uint GROUP = 4; // splats whose alphas are independent instructions
shared vec4 directions[NORMAL ? BATCH : 1];
shared vec4 tokens[TOKEN_PAIRS > 0 ? BATCH : 1];
Pixel pixels[RUNS];

Values values(uint pair) {
    Values values = NOTHING;
    if (COLOR) values.rgb = colors[pair];
    if (DEPTH) values.depth = depths[pair];
    if (NORMAL) values.normal = normals[pair];
    if (TOKEN_PAIRS > 0) values.token = token_color(pair / max(TOKEN_PAIRS, 1));
    return values;
}

// Branchless: CPU lanes would execute both sides.
void blend(inout Pixel pixel, float alpha, Values values) {
    bool seen = alpha >= ALPHA_MIN && pixel.transmittance > 0;
    float left = pixel.transmittance * (1 - alpha);
    bool drawn = seen && left > TRANSMITTANCE_MIN;
    float weight = drawn ? alpha * pixel.transmittance : 0;
    if (COLOR) pixel.sum.rgb += weight * values.rgb;
    if (DEPTH) pixel.sum.depth += weight * values.depth;
    if (NORMAL) pixel.sum.normal += weight * values.normal;
    if (TOKEN_PAIRS > 0) pixel.sum.token += weight * values.token;
    pixel.transmittance = drawn ? left : seen ? -pixel.transmittance : pixel.transmittance;
}

uint store(uint at, vec3 value) {
    for (uint c = 0; c < 3; c++) frames[at++] = value[c];
    return at;
}

void store(Pixel pixel, uint at) {
    float left = abs(pixel.transmittance);
    if (HAS_BACKGROUND) pixel.sum.rgb += left * background;
    if (COLOR) at = store(at, pixel.sum.rgb);
    if (ALPHA) frames[at++] = 1 - left;
    if (DEPTH) frames[at++] = EXPECTED_DEPTH ? pixel.sum.depth / max(1 - left, LEAST_DIVISOR) : pixel.sum.depth;
    if (NORMAL) at = store(at, pixel.sum.normal / max(length(pixel.sum.normal), LEAST_DIVISOR));
    if (TOKEN_PAIRS > 0) store(at, pixel.sum.token);
}

Splat load(uint pair) { return Splat(xy_opacities[pair], conics[pair], values(pair)); }

// Stores the splats that reach the workgroup; returns their number.
uint store_batch(Splat splat, bool inside) {
    vec4 shade = vec4(splat.values.rgb, splat.values.depth);
    uint at, count = put(falloff(splat.xy_opacity, splat.conic), shade, inside, at);
    if (NORMAL && at < BATCH) directions[at] = vec4(splat.values.normal, 0);
    if (TOKEN_PAIRS > 0 && at < BATCH) tokens[at] = vec4(splat.values.token, 0);
    subgroupBarrier();
    return count;
}

Values batch_values(uint at) {
    Values values = NOTHING;
    if (COLOR) values.rgb = shades[at].rgb;
    if (DEPTH) values.depth = shades[at].w;
    if (NORMAL) values.normal = directions[at].xyz;
    if (TOKEN_PAIRS > 0) values.token = tokens[at].xyz;
    return values;
}

// Returns false once all pixels of the workgroup are done.
bool blend_batch(uint count) {
    for (uint first = 0; first < count; first += GROUP) {
        float alphas[GROUP][RUNS]; // negative if not seen
        for (uint n = 0; n < GROUP; n++) {
            Falloff splat = batch_falloff(first + n);
            for (uint run = 0; run < RUNS; run++) {
                Sight sight;
                bool seen = sees(splat, run, sight) && first + n < count;
                float alpha = min(ALPHA_MAX, alpha(splat, sight));
                alphas[n][run] = seen ? alpha : -1;
            }
        }
        bool live = false;
        for (uint n = 0; n < GROUP; n++) {
            Values seen = batch_values(first + n);
            for (uint run = 0; run < RUNS; run++) {
                if (alphas[n][run] >= 0) blend(pixels[run], alphas[n][run], seen);
                if (n == GROUP - 1) live = live || pixels[run].transmittance > 0;
            }
        }
        if (!subgroupAny(live)) return false;
    }
    return true;
}

// Loads batches ahead: values by one, indices by two.
void blend_batches(uint start, uint end) {
    uint i = start + gl_LocalInvocationID.x, last = end - 1;
    Splat next = load(pair_indices[min(i, last)]);
    uint pair = pair_indices[min(i + LANES, last)];
    for (uint first = start; first < end; first += LANES, i += LANES) {
        Splat splat = next;
        next = load(pair);
        pair = pair_indices[min(i + 2 * LANES, last)];
        if (!blend_batch(store_batch(splat, i < end))) break;
    }
}

void main() {
    for (uint run = 0; run < RUNS; run++) {
        pixels[run] = Pixel(all(lessThan(position(run), size)) ? 1 : -1, NOTHING);
    }
    uint list = (gl_WorkGroupID.z * grid.y + tile().y) * grid.x + tile().x;
    uint start = tile_offsets[list], end = tile_offsets[list + 1];
    if (BATCHED && start < end) blend_batches(start, end);
    for (uint i = start; !BATCHED && i < end; i++) {
        uint pair = pair_indices[i];
        Values seen = values(pair);
        Falloff splat = falloff(xy_opacities[pair], conics[pair]);
        bool live = false;
        for (uint run = 0; run < RUNS; run++) {
            Sight sight;
            if (sees(splat, run, sight)) blend(pixels[run], min(ALPHA_MAX, alpha(splat, sight)), seen);
            live = live || pixels[run].transmittance > 0;
        }
        if (!subgroupAny(live)) break;
    }

    const uint channels = (COLOR ? 3 : 0) + (ALPHA ? 1 : 0) + (DEPTH ? 1 : 0) + (NORMAL ? 3 : 0) + (TOKEN_PAIRS > 0 ? 3 : 0);
    for (uint run = 0; run < RUNS; run++) {
        uvec2 at = position(run);
        if (any(greaterThanEqual(at, size))) continue;
        uint row = gl_WorkGroupID.z * row_count + at.y - first_tile_row * TILE;
        store(pixels[run], (row * size.x + at.x) * channels);
    }
}
