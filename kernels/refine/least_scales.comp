// Computes the least scale of each Gaussian that its cameras resolve.
//
// Means       [N, 3] f32, world
// Cameras     [C, 2, 4, 4] f32, see shared/camera
// Sizes       [C, 2] u32, width and height in pixels
// LeastScales [N] f32, world, 0 if no camera sees the center
//
// One invocation owns one Gaussian. The sampling rate is the largest focal length over depth of
// cameras that see the center within MARGIN of their image.
// Source: Mip-Splatting (Yu et al. 2024), 3D smoothing filter.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/camera.glsl"
#include "shared/index.glsl"
#include "shared/splat.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer Means { vec3 means[]; };
layout(set = 0, binding = 1) readonly buffer Cameras { vec4 cameras[]; };
layout(scalar, set = 0, binding = 2) readonly buffer Sizes { uvec2 sizes[]; };
layout(set = 0, binding = 3) writeonly buffer LeastScales { float least_scales[]; };
layout(push_constant) uniform Push { uint count; uint camera_count; float near; };

const float VARIANCE = 0.2; // of the filter, in squared sampling intervals

void main() {
    uint n = global_index();
    if (n >= count) return;
    float rate = 0;
    for (uint camera = 0; camera < camera_count; camera++) {
        uint row = CAMERA_ROWS * camera;
        mat4x3 view = transpose(mat3x4(cameras[row], cameras[row + 1], cameras[row + 2]));
        vec3 rest = vec3(cameras[row + 4].w, cameras[row + 5].w, cameras[row + 6].w);
        vec4 lens = cameras[row + 3];
        vec3 p = mat3(view) * from_center(means[n], view[3], rest);
        vec2 size = sizes[camera], place = lens.xy * p.xy / p.z + lens.zw;
        bool inside = all(greaterThan(place, -MARGIN * size)) && all(lessThan(place, (1 + MARGIN) * size));
        if (p.z >= near && inside) rate = max(rate, max(lens.x, lens.y) / p.z);
    }
    least_scales[n] = rate > 0 ? sqrt(VARIANCE) / rate : 0;
}
