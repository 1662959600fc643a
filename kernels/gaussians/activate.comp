// Converts the head's raw output to Gaussians.
//
// Raw       [gaussians, 11 + 3 * bases] f32: mean 3, scale 3, quat 4, opacity 1, SH (basis, RGB)
// Unit      [1] f32, world length of a network unit
// Means     [gaussians, 3] f32, world (first view's camera)
// Scales    [gaussians, 3] f32, standard deviations, world
// Quats     [gaussians, 4] f32, wxyz, unit
// Opacities [gaussians] f32, 0..1
// ShCoeffs  [gaussians, bases, 3] f32
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/head.glsl"
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Raw { float raw[]; };
layout(set = 0, binding = 1) readonly buffer Unit { float unit; };
layout(set = 0, binding = 2) writeonly buffer Means { float means[]; };
layout(set = 0, binding = 3) writeonly buffer Scales { float scales[]; };
layout(set = 0, binding = 4) writeonly buffer Quats { float quats[]; };
layout(set = 0, binding = 5) writeonly buffer Opacities { float opacities[]; };
layout(set = 0, binding = 6) writeonly buffer ShCoeffs { float sh_coeffs[]; };

layout(push_constant) uniform Push {
    uint count;
    uint bases;
};

// exp(x) - 1 for x >= 0; a series where the difference would cancel.
float expm1(float x) {
    float series = x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)))));
    return x < 0.35 ? series : exp(x) - 1.0;
}

// log(1 + exp(x)), or x above 20, as in PyTorch. Near 1, log is exact to 2^-21 only, too coarse for
// small scales: there, the series of 2 atanh(u / (2 + u)) = log(1 + u).
float softplus(float x) {
    float u = exp(min(x, 20.0));
    float s = u / (2.0 + u);
    float t = s * s;
    float series = 2.0 * s * (1.0 + t * (1.0 / 3.0 + t * (1.0 / 5.0 + t * (1.0 / 7.0 + t / 9.0))));
    return x > 20.0 ? x : (u < 0.5 ? series : log(1.0 + u));
}

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint at = i * (11 + 3 * bases);
    for (uint c = 0; c < 3; c++) {
        float y = clamp(raw[at + c], -FARTHEST, FARTHEST);
        means[3 * i + c] = unit * (sign(y) * expm1(abs(y)));
        scales[3 * i + c] = unit * clamp(softplus(raw[at + 3 + c] - SCALE_SHIFT), SCALES.x, SCALES.y);
    }
    vec4 q = vec4(raw[at + 6], raw[at + 7], raw[at + 8], raw[at + 9]);
    if (q != vec4(0)) q = length_of(q) >= SHORTEST ? direction_of(q) : q / SHORTEST;
    for (uint c = 0; c < 4; c++) quats[4 * i + c] = q[c];
    opacities[i] = 1.0 / (1.0 + exp(-raw[at + 10]));
    for (uint c = 0; c < 3 * bases; c++) sh_coeffs[3 * bases * i + c] = raw[at + 11 + c];
}
