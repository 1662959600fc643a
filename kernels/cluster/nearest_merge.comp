// The nearest target of every point out of the nearest of each share of the targets.
//
// Scores      [shares, points] f32, the less the nearer
// Candidates  [shares, points] index of a target; indices rise from share to share
// Out         [points] index of a target; of equally near ones the first
//
// One invocation owns a point.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Scores { float scores[]; };
layout(set = 0, binding = 1) readonly buffer Candidates { uint candidates[]; };
layout(set = 0, binding = 2) writeonly buffer Out { uint result[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint shares;
};

void main() {
    uint point = global_index();
    if (point >= point_count) {
        return;
    }
    float best = scores[point];
    uint nearest = candidates[point];
    for (uint share = 1; share < shares; share++) {
        float score = scores[share * point_count + point];
        if (score < best) {
            best = score;
            nearest = candidates[share * point_count + point];
        }
    }
    result[point] = nearest;
}
