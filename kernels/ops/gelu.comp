// Applies the exact (erf) GELU, its backward pass, or SiLU.
//
// Source   [count] f32, before activation
// Gradient [count] f32, d loss / d GELU; read if BACKWARD
// Out      [count] f32, GELU, SiLU, or d loss / d Source if BACKWARD; may alias Gradient
#version 460
layout(local_size_x = 64) in;
#include "shared/gelu.glsl"
#include "shared/index.glsl"

layout(constant_id = 1) const bool BACKWARD = false;
layout(constant_id = 2) const bool SILU = false;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) readonly buffer Gradient { float gradient[]; };
layout(set = 0, binding = 2) buffer Out { float result[]; };
layout(push_constant) uniform Push { uint count; };

const float DENSITY = 0.39894228; // of the normal distribution at 0

void main() {
    uint i = global_index();
    if (i >= count) return;
    float x = source[i];
    if (BACKWARD) {
        float slope = 0.5 + 0.5 * erf(x * SQRT_HALF) + x * DENSITY * exp(-0.5 * x * x);
        result[i] = gradient[i] * slope;
    } else {
        result[i] = SILU ? silu(x) : gelu(x);
    }
}
