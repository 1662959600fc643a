// The mean of the points assigned to each cluster; a cluster without points gets the zero vector.
//
// Points        [points, width] f32
// ClusterOfPoint [points] index of a cluster
// Centroids     [clusters, width] f32
//
// One workgroup (a subgroup) owns a cluster and adds its points in their order, so the bits never change. Looking
// through all assignments costs 1 / width of computing them.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_ballot : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

const uint CHANNELS = 8; // accumulated by a lane at a time

layout(set = 0, binding = 0) readonly buffer Points { float points[]; };
layout(set = 0, binding = 1) readonly buffer ClusterOfPoint { uint cluster_of_point[]; };
layout(set = 0, binding = 2) writeonly buffer Centroids { float centroids[]; };

layout(push_constant) uniform Push {
    uint point_count;
    uint cluster_count;
    uint width;
};

void main() {
    uint cluster = group_index();
    if (cluster >= cluster_count) {
        return;
    }
    uint lane = gl_LocalInvocationID.x;
    uint lanes = gl_WorkGroupSize.x;
    for (uint base = 0; base < width; base += lanes * CHANNELS) {
        float sum[CHANNELS];
        for (uint c = 0; c < CHANNELS; c++) {
            sum[c] = 0.0;
        }
        uint count = 0;
        for (uint tile = 0; tile < point_count; tile += lanes) {
            uint point = tile + lane;
            bool mine = point < point_count && cluster_of_point[min(point, point_count - 1)] == cluster;
            uvec4 members = subgroupBallot(mine);
            count += subgroupBallotBitCount(members);
            while (any(notEqual(members, uvec4(0)))) {
                uint member = subgroupBallotFindLSB(members);
                members[member / 32] &= ~(1u << (member % 32));
                for (uint c = 0; c < CHANNELS; c++) {
                    uint channel = base + c * lanes + lane;
                    if (channel < width) {
                        sum[c] += points[(tile + member) * width + channel];
                    }
                }
            }
        }
        for (uint c = 0; c < CHANNELS; c++) {
            uint channel = base + c * lanes + lane;
            if (channel < width) {
                centroids[cluster * width + channel] = sum[c] / float(max(count, 1));
            }
        }
    }
}
