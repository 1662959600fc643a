// Mean of each cluster's points, zero for empty clusters.
//
// Points    [points, width] f32, width a multiple of 4
// Members   [points] u32, points by cluster, ascending within
// Starts    [clusters + 1] u32, first member of each cluster
// Centroids [clusters, width] f32
//
// One invocation owns four channels of a cluster and adds in order.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Points { vec4 points[]; };
layout(set = 0, binding = 1) readonly buffer Members { uint members[]; };
layout(set = 0, binding = 2) readonly buffer Starts { uint starts[]; };
layout(set = 0, binding = 3) writeonly buffer Centroids { vec4 centroids[]; };

layout(push_constant) uniform Push {
    uint cluster_count;
    uint width;
};

void main() {
    uint quads = width / 4;
    uint i = global_index();
    if (i >= cluster_count * quads) return;
    uint from = starts[i / quads], to = starts[i / quads + 1];
    vec4 sum = vec4(0.0);
    for (uint member = from; member < to; member++) sum += points[members[member] * quads + i % quads];
    centroids[i] = sum / float(max(to - from, 1));
}
