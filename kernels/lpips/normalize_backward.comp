// Backward pass of lpips/normalize, accumulated.
//
// Source  [pixels, channels] f32, 0..1, RGB first
// DOut    [pixels, 3] f32
// DSource [pixels, channels] f32, plus weight times the gradient
//
// If CLIPPED, values outside (0, 1) have no gradient.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"
#include "shared/lpips.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool CLIPPED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer DOut { float d_out[]; };
layout(set = 0, binding = 2) buffer DSource { float d_source[]; };
layout(push_constant) uniform Push { uint count; uint channels; float weight; };

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint at = i / 3 * channels + i % 3;
    if (CLIPPED && !(source[at] > 0 && source[at] < 1)) return;
    d_source[at] += weight * 2 / SCALE[i % 3] * d_out[i];
}
