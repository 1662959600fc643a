// Nearest target of every point by squared Euclidean distance; ties by shared/nearest_tie.
//
// Points  [points, width] f32
// Targets [targets, width] f32
// Out     [points] u32, targets
//
// Sums of squared differences do not cancel far from the origin. One subgroup owns ROWS points;
// lanes scan different targets. A lane keeps its nearest target and the first that ties with it,
// enough unless three targets span a tie's width.
// Source: flash k-means, without a distance matrix.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

const uint ROWS = NEAREST_ROWS;
const uint COLUMNS = 4;

layout(set = 0, binding = 0) readonly buffer Points { vec4 points[]; };
layout(set = 0, binding = 1) readonly buffer Targets { vec4 targets[]; };
layout(set = 0, binding = 2) writeonly buffer Out { uint result[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint target_count;
    uint width;
    float tie;
};

#include "shared/nearest_tie.glsl"

float squared_length(vec4 d) { return dot(d, d); }

void main() {
    uint first_point = group_index() * ROWS;
    if (first_point >= point_count) return;
    uint quads = width / 4;
    uint point_at[ROWS];
    float best[ROWS];
    uint best_target[ROWS];
    float first[ROWS];
    uint first_target[ROWS];
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        point_at[r] = min(first_point + r, point_count - 1) * quads;
        best[r] = uintBitsToFloat(INFINITY_BITS);
        best_target[r] = 0;
        first[r] = best[r];
        first_target[r] = 0;
    }
    for (uint tile = 0; tile < target_count; tile += gl_WorkGroupSize.x * COLUMNS) {
        uint target_at[COLUMNS];
        vec4 sum[ROWS];
        [[unroll]] for (uint c = 0; c < COLUMNS; c++) {
            uint t = tile + COLUMNS * gl_LocalInvocationID.x + c;
            target_at[c] = min(t, target_count - 1) * quads;
        }
        [[unroll]] for (uint r = 0; r < ROWS; r++) sum[r] = vec4(0.0);
        for (uint k = 0; k < quads; k++) {
            vec4 t0 = targets[target_at[0] + k];
            vec4 t1 = targets[target_at[1] + k];
            vec4 t2 = targets[target_at[2] + k];
            vec4 t3 = targets[target_at[3] + k];
            [[unroll]] for (uint r = 0; r < ROWS; r++) {
                vec4 p = points[point_at[r] + k];
                sum[r] += vec4(squared_length(p - t0), squared_length(p - t1), squared_length(p - t2),
                               squared_length(p - t3));
            }
        }
        // A lane's targets ascend, so the first of a tie is kept.
        [[unroll]] for (uint r = 0; r < ROWS; r++) {
            [[unroll]] for (uint c = 0; c < COLUMNS; c++) {
                uint t = tile + COLUMNS * gl_LocalInvocationID.x + c;
                if (t < target_count && sum[r][c] < best[r]) {
                    best[r] = sum[r][c];
                    best_target[r] = t;
                    if (first[r] > tie_limit(best[r])) {
                        first[r] = best[r];
                        first_target[r] = t;
                    }
                }
            }
        }
    }
    [[unroll]] for (uint r = 0; r < ROWS; r++) {
        float limit = tie_limit(subgroupMin(best[r]));
        uint own = first[r] <= limit ? first_target[r] : best[r] <= limit ? best_target[r] : target_count - 1;
        uint nearest = subgroupMin(own);
        if (gl_LocalInvocationID.x == 0 && first_point + r < point_count) result[first_point + r] = nearest;
    }
}
