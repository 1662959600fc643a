// Adds two arrays.
//
// Left, Right [count] f32
// Out         [count] f32, may alias Left
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Left { float left[]; };
layout(set = 0, binding = 1) readonly buffer Right { float right[]; };
layout(set = 0, binding = 2) buffer Out { float result[]; };

layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = global_index();
    if (i < count) result[i] = left[i] + right[i];
}
