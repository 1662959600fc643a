// Copies a buffer, to measure memory bandwidth.
//
// Source, Out [quads] 16 bytes
//
// Not a transfer command, which runs on a slower unit of some GPUs.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { uvec4 source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { uvec4 result[]; };

layout(push_constant) uniform Push {
    uint quads;
};

void main() {
    if (global_index() < quads) result[global_index()] = source[global_index()];
}
