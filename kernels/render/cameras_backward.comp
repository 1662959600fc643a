// Sums the gradients of each camera.
//
// Parts    [rows, C, 10] f32, of render/project_backward
// DCameras [C, 10] f32, accumulated
//
// One subgroup owns one number of one camera. The order of sums is fixed.
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Parts { float parts[]; };
layout(set = 0, binding = 1) buffer DCameras { float d_cameras[]; };
layout(push_constant) uniform Push { uint rows; uint numbers; };

void main() {
    uint number = group_index();
    if (number >= numbers) return;
    float sum = 0;
    for (uint row = gl_LocalInvocationID.x; row < rows; row += gl_WorkGroupSize.x) sum += parts[row * numbers + number];
    sum = subgroupAdd(sum);
    if (subgroupElect()) d_cameras[number] += sum;
}
