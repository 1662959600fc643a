// Places special tokens ahead of the patches of each view, and adds position embeddings.
//
// Patches   [views * patches, width] f32
// Special   [kinds, leading, width] f32: the first of the reference view, `others` of other views
// Positions [leading + patches, width] f32; read if PLACED
// Out       [views, leading + patches, width] f32
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool PLACED = true;

layout(set = 0, binding = 0) readonly buffer Patches { float patches[]; };
layout(set = 0, binding = 1) readonly buffer Special { float special[]; };
layout(set = 0, binding = 2) readonly buffer Positions { float positions[]; };
layout(set = 0, binding = 3) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint views;
    uint tokens; // per view, special ones included
    uint width;
    uint leading;
    uint reference;
    uint others;
};

void main() {
    uint i = global_index();
    if (i >= views * tokens * width) return;
    uint channel = i % width;
    uint token = i / width % tokens;
    uint view = i / width / tokens;
    uint kind = view == reference ? 0 : others;
    float x = token < leading ? special[(kind * leading + token) * width + channel]
                              : patches[(view * (tokens - leading) + token - leading) * width + channel];
    result[i] = PLACED ? x + positions[token * width + channel] : x;
}
