// Computes 1 - SSIM per pixel and its derivatives by the filtered images.
//
// Moments  [C, height, width, 3, 4] f32, of loss/moments
// Partials [C, height, width, 3, 3] f32, half the derivatives of `weight` (1 - SSIM) by the
//          means of a - MIDDLE, of its square and b's, and of (a - b)^2
// Sums     [C, runs, groups] f32, `weight` (1 - SSIM) per workgroup
//
// One subgroup owns RUN rows, one column and color a lane. With means a, b and d = a - b, 1 - SSIM
// is u + v - uv: u = d^2 / (a^2 + b^2 + C1), v = var d / (var a + var b + C2). This does not cancel
// for similar images.
#version 460
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint RUN = 8;
#include "shared/moments.glsl"
#include "shared/window.glsl"

layout(set = 0, binding = 0) readonly buffer Moments { vec4 moments[]; };
layout(scalar, set = 0, binding = 1) writeonly buffer Partials { vec3 partials[]; };
layout(set = 0, binding = 2) writeonly buffer Sums { float sums[]; };
layout(push_constant) uniform Push { uvec2 size; float weight; };

const float C1 = 1e-4, C2 = 9e-4;

float dssim(vec4 moments, out vec3 partial) {
    float a = moments.x, d = moments.y, b = a - d;
    float means = a * a + b * b + C1, variances = moments.z + C2;
    float u = d * d / means, v = moments.w / variances, by_square = (1 - u) / variances;
    partial = vec3((1 - v) * (d - a * u) / means - (d - (a - MIDDLE) * v) * by_square, -v * by_square, by_square);
    return u + v - u * v;
}

void main() {
    uint across = 3 * size.x, column = gl_WorkGroupID.x * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint first = gl_WorkGroupID.z * size.y, at = min(column, across - 1);
    vec2 center = moments[(first + min(gl_WorkGroupID.y * RUN + RUN / 2, size.y - 1)) * across + at].xy;
    vec4 filtered[RUN];
    [[unroll]] for (uint p = 0; p < RUN; p++) filtered[p] = vec4(0);
    [[unroll]] for (int k = 0; k < REACH; k++) {
        int y = int(gl_WorkGroupID.y * RUN) + k - RADIUS;
        vec4 value = vec4(0);
        if (y >= 0 && y < size.y) value = moments[(first + y) * across + at];
        add_tap(filtered, k, squared(value, center));
    }
    float sum = 0;
    [[unroll]] for (uint p = 0; p < RUN; p++) {
        uint y = gl_WorkGroupID.y * RUN + p;
        vec3 partial;
        float here = dssim(centered(filtered[p], center), partial);
        if (y < size.y && column < across) {
            partials[(first + y) * across + column] = weight * partial;
            sum += here;
        }
    }
    sum = weight * subgroupAdd(sum);
    uint groups = (across + gl_WorkGroupSize.x - 1) / gl_WorkGroupSize.x, runs = (size.y + RUN - 1) / RUN;
    if (gl_LocalInvocationID.x == 0) {
        sums[(gl_WorkGroupID.z * runs + gl_WorkGroupID.y) * groups + gl_WorkGroupID.x] = sum;
    }
}
