// Splits centered rows into sums of two f16, with a power-of-two scale per row.
//
// Source [rows, width] f32, width a multiple of 4
// Origin [width] f32
// Out    [rows, pieces, 2, 8] f16, 8 high halves, then 8 low ones; padding is 0
// Scales [rows] f32, powers of two
// Norms  [rows] f32, half the squared length
//
// A row's largest magnitude is scaled to 2^14..2^15. Values are exact to 2^-22, or to 2^-28 of the
// row's largest if the device flushes subnormal f16. One subgroup owns one row.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_shader_16bit_storage : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"
#include "shared/lengths.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

layout(set = 0, binding = 0) readonly buffer Source { vec4 source[]; };
layout(set = 0, binding = 1) readonly buffer Origin { vec4 origin[]; };
layout(set = 0, binding = 2) writeonly buffer Out { f16vec4 result[]; };
layout(set = 0, binding = 3) writeonly buffer Scales { float scales[]; };
layout(set = 0, binding = 4) writeonly buffer Norms { float norms[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
};

// Biased f32 exponents; rows below 2^-100 use the least.
const uint LEAST_EXPONENT = 27;
const uint MOST_EXPONENT = 254;

// Rounds to f16's 11 bits; devices may round or drop conversions. NaN stays NaN: rounding would
// carry into the sign bit.
vec4 rounded(vec4 x) {
    uvec4 bits = floatBitsToUint(x);
    uvec4 near = (bits + 0x1000u) & 0xffffe000u;
    return uintBitsToFloat(mix(near, bits, greaterThan(bits & 0x7fffffffu, uvec4(INFINITY_BITS))));
}

void main() {
    uint row = group_index();
    if (row >= rows) return;
    uint quads = width / 4;
    float largest = 0.0;
    for (uint c = gl_LocalInvocationID.x; c < quads; c += gl_WorkGroupSize.x) {
        largest = max(largest, largest_of(source[row * quads + c] - origin[c]));
    }
    uint exponent = clamp(floatBitsToUint(subgroupMax(largest)) >> 23, LEAST_EXPONENT, MOST_EXPONENT);
    float unit = uintBitsToFloat((exponent - 14) << 23);
    float units = uintBitsToFloat((254 + 14 - exponent) << 23); // 1 / unit

    uint pieces = (width + 7) / 8;
    float squares = 0.0;
    for (uint c = gl_LocalInvocationID.x; c < 2 * pieces; c += gl_WorkGroupSize.x) {
        vec4 x = c < quads ? (source[row * quads + c] - origin[c]) * units : vec4(0.0);
        vec4 high = rounded(x);
        uint at = (row * pieces + c / 2) * 4 + c % 2;
        result[at] = f16vec4(high);
        result[at + 2] = f16vec4(rounded(x - high));
        squares += dot(x, x);
    }
    squares = subgroupAdd(squares);
    if (gl_LocalInvocationID.x == 0) {
        scales[row] = unit;
        // In this order: unit * unit may underflow.
        precise float norm = 0.5 * squares * unit;
        norm *= unit;
        norms[row] = norm;
    }
}
