// Backward pass of refine/exposure.
//
// Frames, Targets, Transforms as of refine/exposure
// Gradient [C, pixels, 3] f32, in place: by the exposed frames, then by the frames
// Sums     [C, 12, groups] f32, gradient by the transforms per workgroup
//
// One subgroup owns RUN pixels a lane. Hidden values have no gradient.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint RUN = 8;
#include "shared/exposure.glsl"
#include "shared/index.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer Frames { vec3 frames[]; };
layout(scalar, set = 0, binding = 1) readonly buffer Targets { vec3 targets[]; };
layout(set = 0, binding = 2) readonly buffer Transforms { vec4 transforms[]; };
layout(scalar, set = 0, binding = 3) buffer Gradient { vec3 gradient[]; };
layout(set = 0, binding = 4) writeonly buffer Sums { float sums[]; };
layout(push_constant) uniform Push { uint cameras; uint pixels; uint groups; uint first; };

void main() {
    uint camera = group_index() / groups, group = group_index() % groups;
    if (camera >= cameras) return;
    vec4 rows[3], sum[3];
    for (uint k = 0; k < 3; k++) {
        rows[k] = transforms[3 * (first + camera) + k];
        sum[k] = vec4(0);
    }
    for (uint p = 0; p < RUN; p++) {
        uint pixel = (group * RUN + p) * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
        if (pixel >= pixels) break;
        uint i = camera * pixels + pixel;
        vec4 color = vec4(frames[i], 1);
        vec3 target = targets[i], d = gradient[i], result = vec3(0);
        for (uint k = 0; k < 3; k++) {
            if (is_hidden(dot(rows[k], color), target[k])) continue;
            sum[k] += d[k] * color;
            result += d[k] * rows[k].xyz;
        }
        gradient[i] = result;
    }
    for (uint k = 0; k < 12; k++) {
        float all = subgroupAdd(sum[k / 4][k % 4]);
        if (gl_LocalInvocationID.x == 0) sums[(camera * 12 + k) * groups + group] = all;
    }
}
