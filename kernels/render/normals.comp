// Computes normals of Gaussians: the shortest axis, facing the camera.
//
// Means   [N, 3] f32, world
// Scales  [N, 3] f32, standard deviations, world
// Quats   [N, 4] f32, wxyz, any length
// Cameras [C, 2, 4, 4] f32, see shared/camera
// Normals [N, C, 3] f32, unit, world
//
// The first of equally short axes wins.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/camera.glsl"
#include "shared/index.glsl"
#include "shared/lengths.glsl"
#include "shared/rotation.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer Means { vec3 means[]; };
layout(scalar, set = 0, binding = 1) readonly buffer Scales { vec3 scales[]; };
layout(set = 0, binding = 2) readonly buffer Quats { vec4 quats[]; };
layout(set = 0, binding = 3) readonly buffer Cameras { vec4 cameras[]; };
layout(scalar, set = 0, binding = 4) writeonly buffer Normals { vec3 normals[]; };
layout(push_constant) uniform Push { uint pairs; uint camera_count; };

void main() {
    uint pair = global_index();
    if (pair >= pairs) return;
    uint n = pair / camera_count, camera = pair % camera_count;
    mat3 axes = rotation(unit_vector(quats[n]));
    vec3 scale = scales[n];
    vec3 axis = scale.x <= min(scale.y, scale.z) ? axes[0] : scale.y <= scale.z ? axes[1] : axes[2];
    uint at = CAMERA_ROWS * camera;
    vec3 center = vec3(cameras[at].w, cameras[at + 1].w, cameras[at + 2].w);
    vec3 rest = vec3(cameras[at + 4].w, cameras[at + 5].w, cameras[at + 6].w);
    normals[pair] = dot(axis, from_center(means[n], center, rest)) > 0 ? -axis : axis;
}
