// Adds position embeddings to the class token and patches of each view.
//
// Patches    [views * patches, width] f32
// ClassToken [width] f32
// Positions  [1 + patches, width] f32, class token first
// Out        [views, 1 + patches, width] f32
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Patches { float patches[]; };
layout(set = 0, binding = 1) readonly buffer ClassToken { float class_token[]; };
layout(set = 0, binding = 2) readonly buffer Positions { float positions[]; };
layout(set = 0, binding = 3) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint views;
    uint tokens; // per view, class token included
    uint width;
};

void main() {
    uint i = global_index();
    if (i >= views * tokens * width) return;
    uint channel = i % width;
    uint token = i / width % tokens;
    uint view = i / width / tokens;
    float x = token == 0 ? class_token[channel] : patches[(view * (tokens - 1) + token - 1) * width + channel];
    result[i] = x + positions[token * width + channel];
}
