// Hides a random fraction of the Gaussians and scales the opacities of the others.
//
// Opacities [count] f32
// Key       [1] u32, random bits
// Shown     [count] f32, 0 or the opacity times `factor`, at most 1
//
// One invocation owns one Gaussian.
// Source: DropGaussian (Park et al. 2025); hash: PCG (O'Neill 2014), RXS M XS 32.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Opacities { float opacities[]; };
layout(set = 0, binding = 1) readonly buffer Key { uint key; };
layout(set = 0, binding = 2) writeonly buffer Shown { float shown[]; };
layout(push_constant) uniform Push {
    uint count, first; // index of the first Gaussian
    uint least; // hash that is shown
    float factor;
};

void main() {
    uint i = global_index();
    if (i >= count) return;
    uint state = (key ^ (first + i)) * 747796405 + 2891336453u;
    uint word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737;
    shown[i] = ((word >> 22) ^ word) < least ? 0 : min(opacities[i] * factor, 1);
}
