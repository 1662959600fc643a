// Cuts images into patches, one row a patch, as a convolution with stride = kernel size reads them.
//
// Images   [views, 3, height, width] f32, RGB in 0..1
// Out      [views * patches, stride] OUTPUT: 3 * patch * patch values, channel-major as the convolution's weight, then zeros
//
// One invocation an element.
#version 460
#pragma element OUTPUT
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Images { float images[]; };
layout(set = 0, binding = 1) writeonly buffer Out { OUTPUT result[]; };

layout(push_constant) uniform Push {
    uint views;
    uint height;
    uint width;
    uint patch_size;
    uint stride;
};

void main() {
    uint i = global_index();
    uint area = patch_size * patch_size;
    uint columns = width / patch_size;
    uint patches = columns * (height / patch_size);
    if (i >= views * patches * stride) return;
    uint element = i % stride;
    uint p = i / stride;
    if (element >= 3 * area) {
        result[i] = to_OUTPUT(0.0);
        return;
    }
    uint channel = element / area;
    uint y = (p % patches) / columns * patch_size + (element % area) / patch_size;
    uint x = (p % columns) * patch_size + element % patch_size;
    result[i] = to_OUTPUT(images[((p / patches * 3 + channel) * height + y) * width + x]);
}
