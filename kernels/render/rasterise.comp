// Blends the Gaussians of each tile front to back.
//
// pair_indices [intersections] by tile, near to far; tile_offsets [tiles + 1]; xy_opacities, conics, colours [pairs, 3]
// and depths [pairs] as render/project writes them; frames [C, rows, width, channels]: of red, green, blue, alpha and
// depth those asked for. Depth is the sum of z times weight, or, where EXPECTED_DEPTH, that sum over alpha.
// One workgroup owns a run of PIXELS times the subgroup size pixels of one tile, row-major, each invocation every
// subgroup-size-th of them: nothing is shared, and every Gaussian is read at one address by all.
// 3D Gaussian Splatting (Kerbl et al. 2023) with the constants of gsplat 1.5.3.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_vote : require
layout(local_size_x_id = 0) in;
#include "shared/splat.glsl"

layout(constant_id = 1) const bool COLOUR = true;
layout(constant_id = 2) const bool ALPHA = true;
layout(constant_id = 3) const bool DEPTH = false;
layout(constant_id = 4) const bool EXPECTED_DEPTH = false;
layout(constant_id = 5) const uint TILE = 16;  // pixels a side
layout(constant_id = 6) const uint PIXELS = 8; // of one invocation

layout(set = 0, binding = 0) readonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 1) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 3) readonly buffer Conics { vec3 conics[]; };
layout(scalar, set = 0, binding = 4) readonly buffer Colours { vec3 colours[]; };
layout(set = 0, binding = 5) readonly buffer Depths { float depths[]; };
layout(set = 0, binding = 6) writeonly buffer Frames { float frames[]; };
layout(push_constant) uniform Push { uvec2 size; uvec2 grid; uint first_tile_row; uint row_count; vec3 background; };

struct Pixel {
    vec2 centre;
    float transmittance; // negative once the pixel is done
    vec3 rgb;
    float depth;
};

void blend(inout Pixel pixel, vec3 xy_opacity, vec3 conic, vec3 colour, float z) {
    vec2 d = pixel.centre - xy_opacity.xy;
    float e = d.x - conic.y * d.y;
    float alpha = min(ALPHA_MAX, xy_opacity.z * exp(-0.5 * (conic.x * e * e + conic.z * d.y * d.y)));
    if (!(alpha >= ALPHA_MIN && pixel.transmittance > 0)) return;
    float left = pixel.transmittance * (1 - alpha);
    if (left <= TRANSMITTANCE_MIN) {
        pixel.transmittance = -pixel.transmittance;
        return;
    }
    float weight = alpha * pixel.transmittance;
    if (COLOUR) pixel.rgb += weight * colour;
    if (DEPTH) pixel.depth += weight * z;
    pixel.transmittance = left;
}

void store(Pixel pixel, uint at) {
    float left = abs(pixel.transmittance);
    if (COLOUR) {
        vec3 rgb = pixel.rgb + left * background;
        frames[at++] = rgb.r;
        frames[at++] = rgb.g;
        frames[at++] = rgb.b;
    }
    if (ALPHA) frames[at++] = 1 - left;
    if (DEPTH) frames[at] = EXPECTED_DEPTH ? pixel.depth / max(1 - left, 1e-10) : pixel.depth;
}

void main() {
    const uint runs = TILE * TILE / (PIXELS * gl_WorkGroupSize.x);
    uvec2 tile = uvec2(gl_WorkGroupID.x / runs, first_tile_row + gl_WorkGroupID.y);
    uint first = gl_WorkGroupID.x % runs * PIXELS * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    Pixel pixels[PIXELS];
    for (uint j = 0; j < PIXELS; ++j) {
        uint p = first + j * gl_WorkGroupSize.x;
        uvec2 at = tile * TILE + uvec2(p % TILE, p / TILE);
        pixels[j] = Pixel(vec2(at) + 0.5, all(lessThan(at, size)) ? 1 : -1, vec3(0), 0);
    }

    uint tile_id = (gl_WorkGroupID.z * grid.y + tile.y) * grid.x + tile.x;
    uint end = tile_offsets[tile_id + 1];
    for (uint i = tile_offsets[tile_id]; i < end; ++i) {
        uint pair = pair_indices[i];
        vec3 xy_opacity = xy_opacities[pair], conic = conics[pair];
        vec3 colour = COLOUR ? colours[pair] : vec3(0);
        float z = DEPTH ? depths[pair] : 0;
        bool live = false;
        for (uint j = 0; j < PIXELS; ++j) {
            blend(pixels[j], xy_opacity, conic, colour, z);
            live = live || pixels[j].transmittance > 0;
        }
        if (!subgroupAny(live)) break;
    }

    const uint channels = (COLOUR ? 3 : 0) + (ALPHA ? 1 : 0) + (DEPTH ? 1 : 0);
    for (uint j = 0; j < PIXELS; ++j) {
        uvec2 at = uvec2(pixels[j].centre);
        if (any(greaterThanEqual(at, size))) continue;
        uint row = gl_WorkGroupID.z * row_count + at.y - first_tile_row * TILE;
        store(pixels[j], (row * size.x + at.x) * channels);
    }
}
