// Nearest target of cluster/nearest with uniform loads, for CPU drivers.
//
// Points  [panels, width, PANEL_COLUMNS] f32, of cluster/panels
// Targets [targets, width] f32
// Out     [points] u32, targets
//
// One subgroup owns VECTORS points a lane. Surplus targets repeat the last. See shared/uniform.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

#include "shared/uniform.glsl"

layout(constant_id = 1) const uint TERMS = 4; // per loop pass; divides width
layout(constant_id = 2) const uint TILE_ROWS = 6;
layout(constant_id = 3) const uint VECTORS = 2; // VECTORS * subgroup size divides PANEL_COLUMNS

layout(set = 0, binding = 0) readonly buffer Points { float points[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(set = 0, binding = 2) writeonly buffer Out { uint result[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint target_count;
    uint width;
    float tie;
    uvec2 points_address;
    uvec2 targets_address;
};

#include "shared/nearest_tie.glsl"

// Nearest target of each of the lane's points, and the first that ties with it.
float best[VECTORS];
uint best_target[VECTORS];
float first[VECTORS];
uint first_target[VECTORS];

void take(uint v, uint target, float distance) {
    bool nearer = target < target_count && distance < best[v];
    best[v] = nearer ? distance : best[v];
    best_target[v] = nearer ? target : best_target[v];
    // Targets ascend, so the first of a tie is kept.
    bool alone = nearer && first[v] > tie_limit(best[v]);
    first[v] = alone ? distance : first[v];
    first_target[v] = alone ? target : first_target[v];
}

void main() {
    find_lanes();
    const uint tile = VECTORS * gl_WorkGroupSize.x;
    uint first_point = min(group_index(), (point_count - 1) / tile) * tile;
    uint64_t points_at = packUint2x32(points_address)
        + 4 * (uint64_t(first_point / PANEL_COLUMNS * width) * PANEL_COLUMNS + first_point % PANEL_COLUMNS);
    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        best[v] = uintBitsToFloat(INFINITY_BITS);
        best_target[v] = 0;
        first[v] = best[v];
        first_target[v] = 0;
    }
    uint begin = 0;
    do {
        uint64_t target_at[TILE_ROWS];
        float sum[TILE_ROWS][VECTORS];
        [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
            target_at[r] = packUint2x32(targets_address) + 4 * uint64_t(min(begin + r, target_count - 1)) * width;
            [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] = 0.0;
        }
        uint k = 0;
        do {
            uint64_t offset = 4 * uint64_t(k);
            [[unroll]] for (uint j = 0; j < TERMS; j++) {
                float point[VECTORS];
                [[unroll]] for (uint v = 0; v < VECTORS; v++) {
                    point[v] = vector_at(points_at + offset * PANEL_COLUMNS, j * PANEL_COLUMNS + v * gl_WorkGroupSize.x);
                }
                [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
                    float x = Values(target_at[r] + offset).values[j];
                    [[unroll]] for (uint v = 0; v < VECTORS; v++) sum[r][v] += (point[v] - x) * (point[v] - x);
                }
            }
            k += TERMS;
        } while (k < width);
        [[unroll]] for (uint r = 0; r < TILE_ROWS; r++) {
            [[unroll]] for (uint v = 0; v < VECTORS; v++) take(v, begin + r, sum[r][v]);
        }
        begin += TILE_ROWS;
    } while (begin < target_count);

    [[unroll]] for (uint v = 0; v < VECTORS; v++) {
        uint point = first_point + v * gl_WorkGroupSize.x + lane;
        float limit = tie_limit(best[v]);
        uint nearest = first[v] <= limit ? first_target[v] : best[v] <= limit ? best_target[v] : target_count - 1;
        if (point < point_count) result[point] = nearest;
    }
}
