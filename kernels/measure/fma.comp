// Multiplies and adds in registers, to measure arithmetic throughput: x = x * factor + term.
//
// Out [count] f32, sum of an invocation's chains
//
// One invocation owns 4 QUADS chains of `iterations` * STEPS steps. Other chains hide a chain's
// latency; chains start differently, so none is optimized away.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(constant_id = 1) const uint QUADS = 3;
layout(constant_id = 2) const uint STEPS = 8;

layout(set = 0, binding = 0) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint count;
    uint iterations;
    float factor;
    float term;
};

void main() {
    float own = float(global_index() % 16);
    vec4 x[QUADS];
    [[unroll]] for (uint q = 0; q < QUADS; q++) x[q] = own + 16.0 * (4.0 * float(q) + vec4(0.0, 1.0, 2.0, 3.0));
    for (uint i = 0; i < iterations; i++) {
        [[unroll]] for (uint step = 0; step < STEPS; step++) {
            [[unroll]] for (uint q = 0; q < QUADS; q++) x[q] = x[q] * factor + term;
        }
    }
    vec4 sum = vec4(0.0);
    [[unroll]] for (uint q = 0; q < QUADS; q++) sum += x[q];
    if (global_index() < count) result[global_index()] = sum.x + sum.y + sum.z + sum.w;
}
