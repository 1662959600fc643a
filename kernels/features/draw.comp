// Blends values of Gaussians or tokens front to back, 4 VECTORS channels at once.
//
// PairIndices, TileOffsets, XyOpacities, Conics as in render/rasterize
// Features [rows, VECTORS, 4] f32; a row belongs to `group` consecutive Gaussians
// Pictures [rows, W, VECTORS, 4] f32, from first_tile_row on
//
// Draws one camera. Pixels and runs as in render/rasterize.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_vote : require
layout(local_size_x_id = 0) in;
#include "shared/limits.glsl"
#include "shared/splat.glsl"
#include "shared/blend_weight.glsl"

layout(constant_id = 1) const uint RUNS = 8;
layout(constant_id = 2) const uint VECTORS = 4;

layout(set = 0, binding = 0) readonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 1) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 3) readonly buffer Conics { vec3 conics[]; };
layout(set = 0, binding = 4) readonly buffer Features { vec4 features[]; };
layout(set = 0, binding = 5) writeonly buffer Pictures { vec4 pictures[]; };
layout(push_constant) uniform Push { uvec2 size; uvec2 grid; uint first_tile_row; uint group; };

#include "shared/runs.glsl"

void main() {
    float transmittance[RUNS];
    vec4 sums[RUNS * VECTORS];
    for (uint run = 0; run < RUNS; run++) {
        transmittance[run] = all(lessThan(position(run), size)) ? 1 : -1;
        for (uint k = 0; k < VECTORS; k++) sums[run * VECTORS + k] = vec4(0);
    }

    uint list = tile().y * grid.x + tile().x;
    uint end = tile_offsets[list + 1];
    for (uint i = tile_offsets[list]; i < end; i++) {
        uint pair = pair_indices[i];
        vec4 values[VECTORS];
        for (uint k = 0; k < VECTORS; k++) values[k] = features[pair / group * VECTORS + k];
        Falloff splat = falloff(xy_opacities[pair], conics[pair]);
        bool live = false;
        for (uint run = 0; run < RUNS; run++) {
            Sight sight;
            if (sees(splat, run, sight)) {
                float weight = blend_weight(transmittance[run], min(ALPHA_MAX, alpha(splat, sight)));
                for (uint k = 0; k < VECTORS; k++) sums[run * VECTORS + k] += weight * values[k];
            }
            live = live || transmittance[run] > 0;
        }
        if (!subgroupAny(live)) break;
    }

    for (uint run = 0; run < RUNS; run++) {
        uvec2 at = position(run);
        if (any(greaterThanEqual(at, size))) continue;
        for (uint k = 0; k < VECTORS; k++) {
            pictures[((at.y - first_tile_row * TILE) * size.x + at.x) * VECTORS + k] = sums[run * VECTORS + k];
        }
    }
}
