// Mean of evenly spaced rows, an origin near all of them.
//
// Source [rows, width] f32, width a multiple of 4
// Out    [width] f32
//
// One invocation owns four channels and adds `samples` rows in order.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { vec4 source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { vec4 result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
    uint samples;
};

void main() {
    uint quads = width / 4;
    uint quad = global_index();
    if (quad >= quads) return;
    vec4 mean = vec4(0.0);
    uint apart = rows / samples * quads;
    for (uint i = 0; i < samples; i++) mean += source[i * apart + quad] / float(samples);
    result[quad] = mean;
}
