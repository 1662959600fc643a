// Backward pass of gaussians/activate.
//
// Raw, Unit as in gaussians/activate
// DMeans, DScales, DQuats, DOpacities, DShCoeffs as the outputs of gaussians/activate
// DRaw [gaussians / group, stride] f32, `group` Gaussians per row; padding is untouched
//
// Clamped values have no gradient.
#version 460
layout(local_size_x = 64) in;
#include "shared/head.glsl"
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Raw { float raw[]; };
layout(set = 0, binding = 1) readonly buffer Unit { float unit; };
layout(set = 0, binding = 2) readonly buffer DMeans { float d_means[]; };
layout(set = 0, binding = 3) readonly buffer DScales { float d_scales[]; };
layout(set = 0, binding = 4) readonly buffer DQuats { vec4 d_quats[]; };
layout(set = 0, binding = 5) readonly buffer DOpacities { float d_opacities[]; };
layout(set = 0, binding = 6) readonly buffer DShCoeffs { float d_sh_coeffs[]; };
layout(set = 0, binding = 7) writeonly buffer DRaw { float d_raw[]; };
layout(push_constant) uniform Push { uint count; uint bases; uint group; uint stride; };

float sigmoid(float x) { return 1 / (1 + exp(-x)); }

// d softplus / dx, 0 beyond the clamp; below the least scale, softplus is exp(x) to 1e-12.
float scale_slope(float x) { return x >= log(SCALES.x) && x <= SCALES.y ? sigmoid(x) : 0; }

vec4 quat_gradient(vec4 q, vec4 gradient) {
    if (q == vec4(0) || length_of(q) < SHORTEST) return gradient / SHORTEST;
    vec4 direction = direction_of(q);
    return (gradient - dot(gradient, direction) * direction) / length(q / largest_of(q)) / largest_of(q);
}

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint width = 11 + 3 * bases, from = i * width, to = i / group * stride + i % group * width;
    for (uint c = 0; c < 3; c++) {
        float y = raw[from + c];
        d_raw[to + c] = abs(y) <= FARTHEST ? unit * d_means[3 * i + c] * exp(abs(y)) : 0;
        d_raw[to + 3 + c] = unit * d_scales[3 * i + c] * scale_slope(raw[from + 3 + c] - SCALE_SHIFT);
    }
    vec4 quat = quat_gradient(vec4(raw[from + 6], raw[from + 7], raw[from + 8], raw[from + 9]), d_quats[i]);
    for (uint c = 0; c < 4; c++) d_raw[to + 6 + c] = quat[c];
    float opacity = sigmoid(raw[from + 10]), rest = sigmoid(-raw[from + 10]);
    d_raw[to + 10] = d_opacities[i] * opacity * rest;
    for (uint c = 0; c < 3 * bases; c++) d_raw[to + 11 + c] = d_sh_coeffs[3 * bases * i + c];
}
