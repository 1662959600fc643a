// Overwrites each view's first token with its camera token.
//
// CameraTokens [2, width] f32, learned (reference view, other views); [views, width] if ENCODED
// Chosen       [1] u32, reference view, otherwise `reference`; read if ON_DEVICE
// Out          [views, tokens, width] f32
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool ENCODED = false;
layout(constant_id = 2) const bool ON_DEVICE = false;

layout(set = 0, binding = 0) readonly buffer CameraTokens { float camera_tokens[]; };
layout(set = 0, binding = 1) readonly buffer Chosen { uint chosen[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint views;
    uint tokens;
    uint width;
    uint reference;
};

void main() {
    uint i = global_index();
    if (i >= views * width) return;
    uint view = i / width;
    uint row = ENCODED ? view : uint(view != (ON_DEVICE ? chosen[0] : reference));
    result[view * tokens * width + i % width] = camera_tokens[row * width + i % width];
}
