// Cuts images into rows of a patch each, for a convolution with stride = kernel size.
//
// Images [views, 3, height, width] f32, RGB in 0..1
// Out    [views * patches, stride] OUTPUT: 3 * patch * patch values, channel-major, then zeros
//
// NORMALIZED applies ImageNet's means and deviations. One workgroup owns one row: uniform patch
// coordinates, divisions by constants.
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const uint PATCH = 14; // side in pixels
layout(constant_id = 2) const bool NORMALIZED = false;

layout(set = 0, binding = 0) readonly buffer Images { float images[]; };
layout(set = 0, binding = 1) writeonly buffer Out { OUTPUT result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint height;
    uint width;
    uint stride;
};

const vec3 MEAN = vec3(0.485, 0.456, 0.406);
const vec3 DEVIATION = vec3(0.229, 0.224, 0.225);

void main() {
    const uint area = PATCH * PATCH;
    uint row = group_index();
    if (row >= rows) return;
    uint columns = width / PATCH;
    uint patches = columns * (height / PATCH);
    uint corner = (row % patches / columns * width + row % columns) * PATCH;
    uint view = row / patches * 3 * height * width;
    for (uint element = gl_LocalInvocationIndex; element < stride; element += gl_WorkGroupSize.x) {
        float value = 0.0;
        if (element < 3 * area) {
            uint pixel = element % area;
            uint at = element / area * height * width + pixel / PATCH * width + pixel % PATCH;
            value = images[view + corner + at];
            if (NORMALIZED) value = (value - MEAN[element / area]) / DEVIATION[element / area];
        }
        result[row * stride + element] = to_OUTPUT(value);
    }
}
