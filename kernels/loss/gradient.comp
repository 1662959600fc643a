// Computes the gradient of a loss by the frames, and sums the loss.
//
// Frames, DFrames [C, height, width, channels] f32, RGB first; other channels of DFrames are 0
// Targets         [C, height, width, 3] f32
// Partials        [C, height, width, 3, 3] f32, of loss/spread; read if DSSIM
// Sums            [C, runs, groups] f32, POINTWISE losses, added to loss/dssim's if DSSIM
//
// One subgroup owns RUN rows, one column and color a lane.
#version 460
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint RUN = 8;
layout(constant_id = 2) const uint POINTWISE = 0; // 0 none, 1 |a - b|, 2 (a - b)^2
layout(constant_id = 3) const bool DSSIM = false;
#include "shared/window.glsl"

layout(set = 0, binding = 0) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer Partials { vec3 partials[]; };
layout(set = 0, binding = 3) buffer Sums { float sums[]; };
layout(set = 0, binding = 4) writeonly buffer DFrames { float d_frames[]; };
layout(push_constant) uniform Push { uvec2 size; uint channels; float weight; float scale; };

void main() {
    uint across = 3 * size.x, column = gl_WorkGroupID.x * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint first = gl_WorkGroupID.z * size.y;
    vec4 filtered[RUN];
    if (DSSIM) {
        [[unroll]] for (uint p = 0; p < RUN; p++) filtered[p] = vec4(0);
        [[unroll]] for (int k = 0; k < REACH; k++) {
            int y = int(gl_WorkGroupID.y * RUN) + k - RADIUS;
            vec3 value = vec3(0);
            if (y >= 0 && y < size.y) value = partials[(first + y) * across + min(column, across - 1)];
            add_tap(filtered, k, vec4(value, 0));
        }
    }
    float sum = 0;
    [[unroll]] for (uint p = 0; p < RUN; p++) {
        uint y = gl_WorkGroupID.y * RUN + p;
        if (y >= size.y || column >= across) continue;
        uint at = (first + y) * across + column, to = ((first + y) * size.x + column / 3) * channels;
        float frame = frames[to + column % 3], d = frame - targets[at], gradient = 0;
        if (DSSIM) gradient = 2 * (filtered[p].x + (frame - MIDDLE) * filtered[p].y + d * filtered[p].z);
        if (POINTWISE == 1) gradient += weight * sign(d);
        if (POINTWISE == 2) gradient += weight * 2 * d;
        if (POINTWISE > 0) sum += weight * (POINTWISE == 1 ? abs(d) : d * d);
        d_frames[to + column % 3] = scale * gradient;
        if (column % 3 == 0) {
            for (uint c = 3; c < channels; c++) d_frames[to + c] = 0;
        }
    }
    if (POINTWISE == 0) return;
    sum = subgroupAdd(sum);
    uint groups = (across + gl_WorkGroupSize.x - 1) / gl_WorkGroupSize.x, runs = (size.y + RUN - 1) / RUN;
    uint group = (gl_WorkGroupID.z * runs + gl_WorkGroupID.y) * groups + gl_WorkGroupID.x;
    if (gl_LocalInvocationID.x == 0) sums[group] = DSSIM ? sums[group] + sum : sum;
}
