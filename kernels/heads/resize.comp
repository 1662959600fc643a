// Resizes a picture bilinearly, corners on corners, and adds where a pixel lies.
//
// Source    [lines, width, channels] f32, lines source_first on of a picture of `height` lines
// Positions [out_width + out_height, channels / 2] f32, for every column and every line; read where PLACED
// Out       [lines, out_width, channels] f32, lines first on of a picture of out_height lines
//
// Output pixel i lies at i (inputs - 1) / (outputs - 1) of the source. Where PLACED, the first half of the channels gets the
// positions of the pixel's column, the second those of its line. One invocation an element of the result.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const bool PLACED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Positions { float positions[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count;
    uint first;
    uint out_width;
    uint out_height;
    uint channels;
    uint width;
    uint height;
    uint source_first;
};

// The share of the next pixel between two neighbours, of which `near` is the first.
float split(uint at, uint inputs, uint outputs, out uvec2 near) {
    uint steps = max(outputs, 2) - 1, place = at * (inputs - 1);
    near = uvec2(place / steps, min(place / steps + 1, inputs - 1));
    return float(place % steps) / float(steps);
}

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint channel = i % channels, pixel = i / channels;
    uvec2 at = uvec2(pixel % out_width, first + pixel / out_width), xs, ys;
    float right = split(at.x, width, out_width, xs), low = split(at.y, height, out_height, ys);
    vec2 lines[2];
    for (uint j = 0; j < 2; j++) {
        uint line = (ys[j] - source_first) * width;
        for (uint k = 0; k < 2; k++) lines[j][k] = source[(line + xs[k]) * channels + channel];
    }
    float upper = mix(lines[0].x, lines[0].y, right), lower = mix(lines[1].x, lines[1].y, right);
    float value = mix(upper, lower, low);
    if (PLACED) {
        uint half_of = channels / 2;
        value += positions[(channel < half_of ? at.x : out_width + at.y) * half_of + channel % half_of];
    }
    result[i] = value;
}
