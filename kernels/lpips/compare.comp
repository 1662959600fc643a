// Compares rectified features per pixel: sum over channels of weight (a / |a| - b / |b|)^2.
//
// A, B    [pixels, channels] f32, before rectification
// Weights [channels] f32
// Sums    [pixels] f32, times scale
// DA      [pixels, channels] f32, gradient by rectified A; written if GRADIENT, added if ADD
//
// One subgroup owns one pixel.
// Source: LPIPS 0.1 (Zhang et al. 2018), with 1e-10 added to lengths.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;
layout(constant_id = 1) const bool GRADIENT = false;
layout(constant_id = 2) const bool ADD = false;

layout(set = 0, binding = 0) readonly buffer A { float a[]; };
layout(set = 0, binding = 1) readonly buffer B { float b[]; };
layout(set = 0, binding = 2) readonly buffer Weights { float weights[]; };
layout(set = 0, binding = 3) writeonly buffer Sums { float sums[]; };
layout(set = 0, binding = 4) buffer DA { float d_a[]; };

layout(push_constant) uniform Push { uint pixels; uint channels; float scale; };

const float EPSILON = 1e-10;

void main() {
    uint pixel = group_index();
    if (pixel >= pixels) return;
    uint from = pixel * channels;
    vec2 squares = vec2(0);
    for (uint c = gl_LocalInvocationID.x; c < channels; c += gl_WorkGroupSize.x) {
        vec2 values = max(vec2(a[from + c], b[from + c]), 0);
        squares += values * values;
    }
    vec2 lengths = sqrt(subgroupAdd(squares)), inverse = 1 / (lengths + EPSILON);
    precise vec2 sum = vec2(0); // distance, and its gradient along a
    for (uint c = gl_LocalInvocationID.x; c < channels; c += gl_WorkGroupSize.x) {
        // Contraction would tell equal features apart.
        precise vec2 values = max(vec2(a[from + c], b[from + c]), 0) * inverse;
        float difference = values.x - values.y;
        sum += weights[c] * difference * vec2(difference, 2 * values.x);
    }
    sum = subgroupAdd(sum);
    if (gl_LocalInvocationID.x == 0) sums[pixel] = scale * sum.x;
    if (!GRADIENT) return;
    float along = lengths.x > 0 ? sum.y / lengths.x : 0;
    for (uint c = gl_LocalInvocationID.x; c < channels; c += gl_WorkGroupSize.x) {
        precise vec2 values = max(vec2(a[from + c], b[from + c]), 0) * inverse;
        float gradient = scale * (2 * weights[c] * (values.x - values.y) * inverse.x - values.x * along);
        d_a[from + c] = ADD ? d_a[from + c] + gradient : gradient;
    }
}
