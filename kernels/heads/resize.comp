// Resizes an image bilinearly with aligned corners and adds position embeddings.
//
// Source    [lines, width, channels] f32, lines from source_first on of `height`
// Positions [out_width + out_height, channels / 2] f32, per column, then per line; read if PLACED
// Out       [lines, out_width, channels] f32, lines from `first` on of out_height
//
// Column embeddings go to the first half of the channels, line embeddings to the second. One
// subgroup owns one pixel, which keeps divisions out of the loop.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(constant_id = 1) const bool PLACED = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Positions { float positions[]; };
layout(set = 0, binding = 2) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint pixels;
    uint first;
    uint out_width;
    uint out_height;
    uint channels;
    uint width;
    uint height;
    uint source_first;
};

// Neighbors `near` of an output coordinate, and the second one's weight.
float split(uint at, uint inputs, uint outputs, out uvec2 near) {
    uint steps = max(outputs, 2) - 1, place = at * (inputs - 1);
    near = uvec2(place / steps, min(place / steps + 1, inputs - 1));
    return float(place % steps) / float(steps);
}

void main() {
    uint pixel = group_index();
    if (pixel >= pixels) return;
    uvec2 at = uvec2(pixel % out_width, first + pixel / out_width), xs, ys;
    float right = split(at.x, width, out_width, xs), low = split(at.y, height, out_height, ys);
    uvec2 upper_at = ((ys.x - source_first) * width + xs) * channels, lower_at = ((ys.y - source_first) * width + xs) * channels;
    uint half_of = channels / 2;
    // Position offsets for the two halves of the channels.
    uvec2 position_at = uvec2(at.x * half_of, (out_width + at.y) * half_of - half_of);
    for (uint c = gl_LocalInvocationID.x; c < channels; c += gl_WorkGroupSize.x) {
        float upper = mix(source[upper_at.x + c], source[upper_at.y + c], right);
        float lower = mix(source[lower_at.x + c], source[lower_at.y + c], right);
        float value = mix(upper, lower, low);
        if (PLACED) value += positions[(c < half_of ? position_at.x : position_at.y) + c];
        result[pixel * channels + c] = value;
    }
}
