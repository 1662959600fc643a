// Rows about an origin as sums of two f16, a high and a low half, each row scaled by a power of two of its own.
//
// Source  [rows, width] f32, width a multiple of 4
// Origin  [width] f32
// Out     [rows, pieces, 2, 8] f16: of every 8 channels the high halves, then the low ones; channels past the last are zeros
// Scales  [rows] f32: what 1 stands for in a row, a power of two
// Norms   [rows] f32: half the squared length of a row
//
// The largest magnitude of a row lies from 2^14 to 2^15. Both halves together are then off by 2^-22 of a value, or where a
// device flushes subnormal f16 by 2^-28 of the row's largest. One workgroup (a subgroup) owns a row.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_shader_16bit_storage : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

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

// Exponents as f32 holds them, 127 more than they are. Rows below 2^-100 are scaled no more than those.
const uint LEAST_EXPONENT = 27;
const uint MOST_EXPONENT = 254;

// To the 11 bits that f16 has. A conversion there and back would be the device's to round, or to leave out. What is no number
// stays none: the bits of some carry over into the sign.
vec4 rounded(vec4 x) {
    uvec4 bits = floatBitsToUint(x);
    uvec4 near = (bits + 0x1000u) & 0xffffe000u;
    return uintBitsToFloat(mix(near, bits, greaterThan(bits & 0x7fffffffu, uvec4(0x7f800000u))));
}

void main() {
    uint row = group_index();
    if (row >= rows) return;
    uint quads = width / 4;
    float largest = 0.0;
    for (uint c = gl_LocalInvocationID.x; c < quads; c += gl_WorkGroupSize.x) {
        vec4 x = abs(source[row * quads + c] - origin[c]);
        largest = max(largest, max(max(x.x, x.y), max(x.z, x.w)));
    }
    uint exponent = clamp(floatBitsToUint(subgroupMax(largest)) >> 23, LEAST_EXPONENT, MOST_EXPONENT);
    float unit = uintBitsToFloat((exponent - 14) << 23);
    float units = uintBitsToFloat((254 + 14 - exponent) << 23); // in 1

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
        // In this order: the square of the unit alone may be too small for a normal number.
        precise float norm = 0.5 * squares * unit;
        norm *= unit;
        norms[row] = norm;
    }
}
