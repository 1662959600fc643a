// Sums pixel values, times the blending weights of each splat, through each of its tiles.
//
// PairIndices, TileOffsets, TileSets, Slots, XyOpacities, Conics as in render/rasterize_backward
// Values [cells.y, cells.x, vectors, 4] f32; a pixel takes the value of the cell around it
// Sums   [capacity, vectors, 4] f32, per slot
// Totals [capacity] f32, sums of weights, per slot
//
// Pixels whose first value is NaN do not count. One workgroup owns one tile and as many vectors as
// invocations. Invocations compute the weights of BATCH splats at all pixels, then each sums its
// vector in the order of pixels. Totals are in the order of runs, then lanes.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_vote : require
layout(local_size_x_id = 0) in;
#include "shared/limits.glsl"
#include "shared/splat.glsl"
#include "shared/blend_weight.glsl"

layout(constant_id = 1) const uint RUNS = 8;

layout(set = 0, binding = 0) readonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 1) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer TileSets { uvec3 tile_sets[]; };
layout(set = 0, binding = 3) readonly buffer Slots { uint slots[]; };
layout(scalar, set = 0, binding = 4) readonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 5) readonly buffer Conics { vec3 conics[]; };
layout(set = 0, binding = 6) readonly buffer Values { vec4 values[]; };
layout(set = 0, binding = 7) writeonly buffer Sums { vec4 sums[]; };
layout(set = 0, binding = 8) writeonly buffer Totals { float totals[]; };
layout(push_constant) uniform Push {
    uvec2 size;
    uvec2 grid;
    uvec2 cells;
    uint first_tile_row;
    uint vectors;
    uint capacity;
};

#include "shared/runs.glsl"
#include "shared/slots.glsl"

const uint PIXELS = TILE * TILE;
const uint BATCH = 8;
shared vec4 weights[PIXELS * BATCH / 4];

uint cell(uvec2 at) {
    uvec2 cell = at * cells / size;
    return cell.y * cells.x + cell.x;
}

void main() {
    float transmittance[RUNS];
    bool counts[RUNS];
    uint open = 0; // own pixels that are not done
    for (uint run = 0; run < RUNS; run++) {
        bool inside = all(lessThan(position(run), size));
        transmittance[run] = inside ? 1 : -1;
        float first = inside ? values[cell(position(run)) * vectors].x : 0;
        counts[run] = (floatBitsToUint(first) & 0x7fffffffu) <= INFINITY_BITS;
        if (inside) open++;
    }
    uint vector = gl_WorkGroupID.z * LANES + gl_LocalInvocationID.x;
    bool owns = vector < vectors;

    uint list = tile().y * grid.x + tile().x;
    uint i = tile_offsets[list], end = tile_offsets[list + 1];
    for (; i < end && subgroupAny(open > 0); i += BATCH) {
        uint count = min(BATCH, end - i);
        uint batch[BATCH]; // slots; found once, since lavapipe loses buffers between loops
        for (uint b = 0; b < BATCH; b++) {
            uint pair = pair_indices[min(i + b, end - 1)];
            Falloff splat = falloff(xy_opacities[pair], conics[pair]);
            float total = 0;
            for (uint run = 0; run < RUNS; run++) {
                float weight = 0;
                Sight sight;
                if (b < count && sees(splat, run, sight)) {
                    bool was = transmittance[run] > 0;
                    weight = blend_weight(transmittance[run], min(ALPHA_MAX, alpha(splat, sight)));
                    if (was && transmittance[run] <= 0) open--;
                }
                if (!counts[run]) weight = 0;
                weights[(run * LANES + gl_LocalInvocationID.x) * BATCH / 4 + b / 4][b % 4] = weight;
                total += weight;
            }
            total = subgroupAdd(total);
            batch[b] = b < count ? slot_of(pair) : capacity;
            if (batch[b] < capacity && gl_WorkGroupID.z == 0 && subgroupElect()) totals[batch[b]] = total;
        }
        barrier();
        vec4 sum[BATCH];
        for (uint b = 0; b < BATCH; b++) sum[b] = vec4(0);
        for (uint p = 0; p < PIXELS; p++) {
            vec4 first = weights[2 * p], second = weights[2 * p + 1];
            if (first + second == vec4(0)) continue;
            vec4 value = values[cell(tile() * TILE + uvec2(p % TILE, p / TILE)) * vectors + min(vector, vectors - 1)];
            for (uint b = 0; b < 4; b++) {
                sum[b] += first[b] * value;
                sum[b + 4] += second[b] * value;
            }
        }
        for (uint b = 0; b < BATCH; b++) {
            if (owns && batch[b] < capacity) sums[batch[b] * vectors + vector] = sum[b];
        }
        barrier();
    }
    // The remaining splats are hidden.
    const uint first = gl_WorkGroupID.z * LANES;
    for (i += gl_LocalInvocationID.x; i < end; i += LANES) {
        uint slot = slot_of(pair_indices[i]);
        if (slot >= capacity) continue;
        for (uint v = first; v < min(first + LANES, vectors); v++) sums[slot * vectors + v] = vec4(0);
        if (gl_WorkGroupID.z == 0) totals[slot] = 0;
    }
}
