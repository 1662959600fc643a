// Hides masked pixels: those of frames become the target's, those of a gradient 0.
//
// Frames, Targets [pixels, 3] f32, not read if GRADIENT
// Masks           [ceil(pixels / 4)] u32 of 4 bytes, the first in the lowest bits; 0 hides a pixel
// Result          [pixels, 3] f32: masked frames; if GRADIENT the gradient, in place
//
// One invocation owns one value.
#version 460
layout(local_size_x = 64) in;
layout(constant_id = 1) const bool GRADIENT = false;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(set = 0, binding = 2) readonly buffer Masks { uint masks[]; };
layout(set = 0, binding = 3) buffer Result { float result[]; };
layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = global_index(), pixel = i / 3;
    if (i >= count) return;
    bool hidden = bitfieldExtract(masks[pixel / 4], int(8 * (pixel % 4)), 8) == 0;
    if (!GRADIENT) {
        result[i] = hidden ? targets[i] : frames[i];
    } else if (hidden) {
        result[i] = 0;
    }
}
