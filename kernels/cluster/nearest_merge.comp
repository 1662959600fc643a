// Nearest target of every point among the shares' candidates; ties by shared/nearest_tie.
//
// Points     [points, width] f32
// Targets    [targets, width] f32
// Norms      [points] f32, half the squared distance from the origin
// Candidates [shares, points] u32, of cluster/nearest_matrix
// Out        [points] u32, targets
//
// f32 differences decide between targets within the error bound. Of three distinct targets that tie
// within a share, only two are candidates. One subgroup owns one point.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

layout(set = 0, binding = 0) readonly buffer Points { vec4 points[]; };
layout(set = 0, binding = 1) readonly buffer Targets { vec4 targets[]; };
layout(set = 0, binding = 2) readonly buffer Norms { float norms[]; };
layout(set = 0, binding = 3) readonly buffer Candidates { uvec4 candidates[]; };
layout(set = 0, binding = 4) writeonly buffer Out { uint result[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint width;
    uint shares;
    float tie;
};

#include "shared/nearest_tie.glsl"

const uint NONE = 0xffffffffu;

// Target of candidate i, or NONE if its score exceeds `limit`.
uint candidate(uint point, uint i, float limit) {
    uvec4 found = candidates[i / 2 * point_count + point];
    uvec2 one = i % 2 == 0 ? found.xy : found.zw;
    return uintBitsToFloat(one.x) <= limit ? one.y : NONE;
}

float squared_distance(uint point, uint target) {
    uint quads = width / 4;
    float sum = 0.0;
    for (uint k = gl_LocalInvocationID.x; k < quads; k += gl_WorkGroupSize.x) {
        vec4 d = points[point * quads + k] - targets[target * quads + k];
        sum += dot(d, d);
    }
    return subgroupAdd(sum);
}

// Largest score within error of the least; |t| <= |p| + d for a target at distance d.
float score_limit(float least, float norm) {
    float sides = 2.0 * sqrt(2.0 * norm) + sqrt(max(2.0 * (least + norm), 0.0));
    return least + sides * sides / 32768.0;
}

uint among(uint point, float limit) {
    float least = uintBitsToFloat(INFINITY_BITS);
    for (uint i = 0; i < 2 * shares; i++) {
        uint target = candidate(point, i, limit);
        if (target != NONE) least = min(least, squared_distance(point, target));
    }
    float tie = tie_limit(least);
    uint first = NONE;
    for (uint i = 0; i < 2 * shares; i++) {
        uint target = candidate(point, i, limit);
        if (target < first && squared_distance(point, target) <= tie) first = target;
    }
    return first;
}

void main() {
    uint point = group_index();
    if (point >= point_count) return;
    uvec2 best = candidates[point].xy;
    for (uint share = 1; share < shares; share++) {
        uvec2 other = candidates[share * point_count + point].xy;
        best = uintBitsToFloat(other.x) < uintBitsToFloat(best.x) ? other : best;
    }
    float least = uintBitsToFloat(best.x);
    float limit = score_limit(least, norms[point]);
    uint count = 0;
    for (uint i = 0; i < 2 * shares; i++) count += candidate(point, i, limit) == NONE ? 0 : 1;
    // A lone candidate needs no distance; without finite scores, the first target wins.
    uint nearest = count > 1 && !isinf(least) ? among(point, limit) : best.y;
    if (gl_LocalInvocationID.x == 0) result[point] = nearest;
}
