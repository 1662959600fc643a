// Packs images to 8 bits per channel.
//
// Frames [count] f32, RGBA
// Packed [count] u32, clamped to 0..1, times 255; red in the lowest byte, blue if BLUE_FIRST
//
// Color is truncated, as in gsplat's viewer; alpha is rounded.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool BLUE_FIRST = false;

layout(set = 0, binding = 0) readonly buffer Frames { vec4 frames[]; };
layout(set = 0, binding = 1) writeonly buffer Packed { uint packed_pixels[]; };

layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = global_index();
    if (i < count) {
        vec4 scaled = clamp(frames[i], 0.0, 1.0) * 255.0;
        uvec4 bytes = uvec4(scaled.rgb, roundEven(scaled.a));
        if (BLUE_FIRST) bytes = bytes.bgra;
        packed_pixels[i] = bytes.r | bytes.g << 8 | bytes.b << 16 | bytes.a << 24;
    }
}
