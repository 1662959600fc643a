// Selects the reference view, whose class token is nearest to the middle of three measures' ranges.
//
// Tokens    [views, tokens, width] f32, class token first in each view
// Direction [width] f32, sum of normalized class tokens
// Scores    [views, 4] f32: mean similarity to other views, length, channel spread, and the sum of
//           their distances from the middle, each 0..0.5
// Reference [1] u32, first view within TIE of the least sum
//
// One subgroup does all. The spread is -mean^2: the variance of normalized channels without a
// constant, whose rounding would dominate.
// Source: saddle-balanced reference view of Depth Anything 3.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

layout(set = 0, binding = 0) readonly buffer Tokens { float tokens[]; };
layout(set = 0, binding = 1) buffer Direction { float direction[]; };
layout(set = 0, binding = 2) buffer Scores { float scores[]; };
layout(set = 0, binding = 3) writeonly buffer Reference { uint reference[]; };

layout(push_constant) uniform Push {
    uint views;
    uint tokens_per_view;
    uint width;
};

const float TIE = 1e-3;
const float FLOOR = 1e-8; // added to each range, as in the source

uint lane() { return gl_LocalInvocationID.x; }

float token(uint view, uint c) { return tokens[view * tokens_per_view * width + c]; }

float length_of(uint view) {
    float squares = 0.0;
    for (uint c = lane(); c < width; c += gl_WorkGroupSize.x) squares += token(view, c) * token(view, c);
    return sqrt(subgroupAdd(squares));
}

void main() {
    for (uint c = lane(); c < width; c += gl_WorkGroupSize.x) direction[c] = 0.0;
    for (uint view = 0; view < views; view++) {
        float scale = 1.0 / length_of(view);
        for (uint c = lane(); c < width; c += gl_WorkGroupSize.x) direction[c] += token(view, c) * scale;
    }
    vec3 least = vec3(1e38), most = vec3(-1e38);
    for (uint view = 0; view < views; view++) {
        float size = length_of(view);
        vec2 sums = vec2(0.0);
        for (uint c = lane(); c < width; c += gl_WorkGroupSize.x) sums += token(view, c) / size * vec2(direction[c], 1.0);
        sums = subgroupAdd(sums);
        float mean = sums.y / float(width);
        vec3 measures = vec3((sums.x - 1.0) / float(views - 1), size, -mean * mean);
        if (lane() == 0) for (uint m = 0; m < 3; m++) scores[4 * view + m] = measures[m];
        least = min(least, measures);
        most = max(most, measures);
    }
    if (lane() != 0) return;
    // Adds FLOOR last: subtracted from `least`, rounding would absorb it and leave 0.
    precise vec3 range = (most - least) + FLOOR * vec3(1.0, 1.0, float(width - 1) / float(width));
    float best = 1e38;
    for (uint view = 0; view < views; view++) {
        float score = 0.0;
        for (uint m = 0; m < 3; m++) score += abs((scores[4 * view + m] - least[m]) / range[m] - 0.5);
        scores[4 * view + 3] = score;
        best = min(best, score);
    }
    uint chosen = views - 1;
    for (uint view = views; view-- > 0;) if (scores[4 * view + 3] <= best + TIE) chosen = view;
    reference[0] = chosen;
}
