// Normalizes RGB for LPIPS: ((2 x - 1) - shift) / scale.
//
// Source [pixels, channels] f32, 0..1 (clamped if CLIPPED), RGB first
// Out    [pixels, 3] f32
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"
#include "shared/lpips.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool CLIPPED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { float result[]; };
layout(push_constant) uniform Push { uint count; uint channels; };

void main() {
    uint i = global_index();
    if (i >= count) return;
    float x = source[i / 3 * channels + i % 3];
    if (CLIPPED) x = clamp(x, 0, 1);
    result[i] = (2 * x - 1 - SHIFT[i % 3]) / SCALE[i % 3];
}
