// Maps the colors of frames to the exposures of their photos.
//
// Frames     [C, pixels, 3] f32
// Targets    [C, pixels, 3] f32, 0..1
// Transforms [first + C, 3, 4] f32, matrix and offset by row
// Exposed    [C, pixels, 3] f32, equal to the target where a saturated photo hides the value
//
// One invocation owns one pixel.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/exposure.glsl"
#include "shared/index.glsl"

layout(scalar, set = 0, binding = 0) readonly buffer Frames { vec3 frames[]; };
layout(scalar, set = 0, binding = 1) readonly buffer Targets { vec3 targets[]; };
layout(set = 0, binding = 2) readonly buffer Transforms { vec4 transforms[]; };
layout(scalar, set = 0, binding = 3) writeonly buffer Exposed { vec3 exposed[]; };
layout(push_constant) uniform Push { uint count; uint pixels; uint first; };

void main() {
    uint i = global_index(), row = (first + i / pixels) * 3;
    if (i >= count) return;
    vec3 color = frames[i], target = targets[i], result;
    for (uint k = 0; k < 3; k++) {
        float value = dot(transforms[row + k], vec4(color, 1));
        result[k] = is_hidden(value, target[k]) ? target[k] : value;
    }
    exposed[i] = result;
}
