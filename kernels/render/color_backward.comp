// Sums splat gradients over tiles and propagates those of color to SH coefficients.
//
// Means     [N, 3] f32, world
// ShCoeffs  [N, (SH_DEGREE + 1)^2, 3] f32
// Cameras   [C, 2, 4, 4] f32, see shared/camera
// Colors    [N, C, 3] f32, of render/project
// Status    [3] u32, of render/intersect
// Slots     [N C + 1] u32, as in render/rasterize_backward
// Moments   [capacity, 6] f32, as Slots
// DValues   [capacity, 3, 4 or 1] f32, as Slots
// DPairs    [N, C, 10] f32, see shared/pair_gradient
// DShCoeffs [N, (SH_DEGREE + 1)^2, 3] f32, accumulated if SCENE_GRADIENTS
//
// One invocation owns one Gaussian; sums are in the order of cameras, then tiles. Gradients are 0
// if intersections exceeded their capacity.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/camera.glsl"
#include "shared/index.glsl"
#include "shared/lengths.glsl"
#include "shared/pair_gradient.glsl"
#include "shared/spherical_harmonics.glsl"
#include "shared/spherical_harmonics_backward.glsl"

layout(constant_id = 1) const bool COLOR = true;
layout(constant_id = 2) const bool DEPTH = false;
layout(constant_id = 3) const uint SH_DEGREE = 0;
layout(constant_id = 4) const bool SCENE_GRADIENTS = true;

layout(scalar, set = 0, binding = 0) readonly buffer Means { vec3 means[]; };
layout(scalar, set = 0, binding = 1) readonly buffer ShCoeffs { vec3 sh_coeffs[]; };
layout(set = 0, binding = 2) readonly buffer Cameras { vec4 cameras[]; };
layout(scalar, set = 0, binding = 3) readonly buffer Colors { vec3 colors[]; };
layout(set = 0, binding = 4) readonly buffer Status { uint status[]; };
layout(set = 0, binding = 5) readonly buffer Slots { uint slots[]; };
layout(scalar, set = 0, binding = 6) readonly buffer Moments { vec3 moments[]; };
layout(set = 0, binding = 7) readonly buffer DValues { float d_values[]; };
layout(scalar, set = 0, binding = 8) writeonly buffer DPairs { PairGradient d_pairs[]; };
layout(scalar, set = 0, binding = 9) buffer DShCoeffs { vec3 d_sh_coeffs[]; };
layout(push_constant) uniform Push { uint gaussians; uint camera_count; };

const uint VALUES = (COLOR ? 3 : 0) + (DEPTH ? 1 : 0);
const uint COEFFS = (SH_DEGREE + 1) * (SH_DEGREE + 1);

PairGradient over_tiles(uint pair) {
    PairGradient sum = PairGradient(vec3(0), vec3(0), vec3(0), 0);
    if (status[0] != status[1] || status[2] != 0) return sum;
    uint end = slots[pair + 1];
    for (uint slot = slots[pair]; slot < end; slot++) {
        sum.first += moments[2 * slot];
        sum.second += moments[2 * slot + 1];
        if (COLOR) {
            for (uint c = 0; c < 3; c++) sum.rgb[c] += d_values[slot * VALUES + c];
        }
        if (DEPTH) sum.depth += d_values[slot * VALUES + VALUES - 1];
    }
    return sum;
}

// Accumulates coefficient gradients and returns the offset's.
vec3 to_coefficients(uint n, uint camera, vec3 d_rgb, inout vec3 d_coeffs[COEFFS]) {
    if (SH_DEGREE == 0) {
        d_coeffs[0] += SH_0 * d_rgb;
        return vec3(0);
    }
    uint at = CAMERA_ROWS * camera;
    vec3 center = vec3(cameras[at].w, cameras[at + 1].w, cameras[at + 2].w);
    vec3 rest = vec3(cameras[at + 4].w, cameras[at + 5].w, cameras[at + 6].w);
    vec3 offset = from_center(means[n], center, rest);
    float largest = largest_of(offset);
    offset /= largest;
    vec3 direction = normalize(offset);
    float basis[16], weights[16];
    spherical_harmonics(SH_DEGREE, direction, basis);
    for (uint k = 0; k < COEFFS; k++) {
        d_coeffs[k] += basis[k] * d_rgb;
        weights[k] = dot(sh_coeffs[n * COEFFS + k], d_rgb);
    }
    vec3 turned = spherical_harmonics_backward(SH_DEGREE, direction, weights);
    return (turned - dot(turned, direction) * direction) / length(offset) / largest;
}

void main() {
    uint n = global_index();
    if (n >= gaussians) return;
    vec3 d_coeffs[COEFFS];
    for (uint k = 0; k < COEFFS; k++) d_coeffs[k] = vec3(0);
    for (uint camera = 0; camera < camera_count; camera++) {
        uint pair = n * camera_count + camera;
        PairGradient sum = over_tiles(pair);
        if (COLOR && sum.rgb != vec3(0)) {
            sum.rgb = mix(vec3(0), sum.rgb, greaterThan(colors[pair], vec3(0)));
            sum.rgb = to_coefficients(n, camera, sum.rgb, d_coeffs);
        }
        d_pairs[pair] = sum;
    }
    if (COLOR && SCENE_GRADIENTS) {
        for (uint k = 0; k < COEFFS; k++) d_sh_coeffs[n * COEFFS + k] += d_coeffs[k];
    }
}
