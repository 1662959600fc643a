// Sums the loss of each image.
//
// Sums   [C, count] f32, of loss/gradient
// Values [first + C] f32, `scale` times each sum, from `first` on
//
// One subgroup owns one image.
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
#include "shared/double_float.glsl"
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Sums { float sums[]; };
layout(set = 0, binding = 1) writeonly buffer Values { float values[]; };
layout(push_constant) uniform Push { uint first; uint count; float scale; };

void main() {
    uint picture = group_index();
    vec2 sum = vec2(0);
    for (uint i = gl_LocalInvocationID.x; i < count; i += gl_WorkGroupSize.x) {
        sum = add(sum, vec2(sums[picture * count + i], 0));
    }
    float all = subgroupAdd(sum.x) + subgroupAdd(sum.y);
    if (gl_LocalInvocationID.x == 0) values[first + picture] = scale * all;
}
