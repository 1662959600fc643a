// Splits colors from frames with depth, and sums the terms of the line from targets to rendered
// inverse depth over pixels with both.
//
// Frames  [C, pixels, 5] f32: RGB, alpha, expected depth
// Targets [C, pixels] f32, inverse depth in any unit, 0 if unknown
// Colors  [C, pixels, 3] f32
// Sums    [C, 5, groups] f32: 1, t, y, t t, t y for targets t and inverse depth y
//
// One subgroup owns RUN pixels a lane.
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint RUN = 8;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(set = 0, binding = 2) writeonly buffer Colors { float colors[]; };
layout(set = 0, binding = 3) writeonly buffer Sums { float sums[]; };
layout(push_constant) uniform Push { uint cameras; uint pixels; uint groups; };
#include "shared/depth_target.glsl"

void main() {
    uint camera = group_index() / groups, group = group_index() % groups;
    if (camera >= cameras) return;
    float sum[5] = float[](0, 0, 0, 0, 0);
    for (uint p = 0; p < RUN; p++) {
        uint pixel = (group * RUN + p) * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
        if (pixel >= pixels) break;
        uint i = camera * pixels + pixel;
        for (uint c = 0; c < 3; c++) colors[3 * i + c] = frames[CHANNELS * i + c];
        float t = targets[i];
        if (!has_depth(t, i)) continue;
        float y = 1 / frames[CHANNELS * i + 4];
        sum[0] += 1;
        sum[1] += t;
        sum[2] += y;
        sum[3] += t * t;
        sum[4] += t * y;
    }
    for (uint k = 0; k < 5; k++) {
        float all = subgroupAdd(sum[k]);
        if (gl_LocalInvocationID.x == 0) sums[(camera * 5 + k) * groups + group] = all;
    }
}
