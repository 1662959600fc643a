// Steps parameters by Adam in their optimization space.
//
// Parameters    [count] f32; SPACE 0: stepped as p; 1: positive, as ln p; 2: in (0, 1), as logit p
// Gradient      [count] f32, d loss / d p
// First, Second [count] f32, moments in the optimization space
// Schedule      [4] f32: rate, 1 / (1 - beta1^t), 1 / (1 - beta2^t), unused
//
// A non-finite gradient or square skips the step.
// Source: Adam (Kingma and Ba 2015), as in PyTorch without decay.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(constant_id = 1) const uint SPACE = 0;

layout(set = 0, binding = 0) buffer Parameters { float parameters[]; };
layout(set = 0, binding = 1) readonly buffer Gradient { float gradient[]; };
layout(set = 0, binding = 2) buffer First { float first[]; };
layout(set = 0, binding = 3) buffer Second { float second[]; };
layout(set = 0, binding = 4) readonly buffer Schedule { float schedule[]; };
layout(push_constant) uniform Push {
    uint count;
    float beta1, beta2, eps;
    float rate, others; // of the first 3 values of every `width`, and of the others
    uint width, phase; // the first value's index modulo `width`
};

const float LARGEST = 3.4e38;
const vec2 POSITIVE = vec2(1e-30, 1e30); // range of p for ln p
const vec2 BETWEEN = vec2(1e-6, 1 - 1e-6); // range of p for logit p

void main() {
    uint i = global_index();
    if (i >= count) return;
    float p = parameters[i], g = gradient[i];
    if (SPACE == 1) {
        p = clamp(p, POSITIVE.x, POSITIVE.y);
        g *= p;
    } else if (SPACE == 2) {
        p = clamp(p, BETWEEN.x, BETWEEN.y);
        g *= p * (1 - p);
    }
    if (!(g * g <= LARGEST)) return; // also NaN
    float m = beta1 * first[i] + (1 - beta1) * g;
    float v = beta2 * second[i] + (1 - beta2) * g * g;
    float d = ((i + phase) % width < 3 ? rate : others) * schedule[0] * m * schedule[1] / (sqrt(v * schedule[2]) + eps);
    if (SPACE == 0) {
        p -= d;
    } else if (SPACE == 1) {
        p = clamp(p * exp(-d), POSITIVE.x, POSITIVE.y);
    } else {
        p = clamp(p / (p + (1 - p) * exp(d)), BETWEEN.x, BETWEEN.y);
    }
    parameters[i] = p;
    first[i] = m;
    second[i] = v;
}
