// Quantizes rows to signed 8-bit integers, each row's largest magnitude to 127.
//
// Source [rows, width] f16, width a multiple of 4
// Out    [rows, width] i8, four per word
// Scales [rows] f32, NaN if the row has a NaN
//
// One subgroup owns one row.
#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_shader_16bit_storage : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_vote : require
#include "shared/index.glsl"
#include "shared/lengths.glsl"

layout(local_size_x_id = 0) in;

layout(set = 0, binding = 0) readonly buffer Source { f16vec4 source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { uint result[]; };
layout(set = 0, binding = 2) writeonly buffer Scales { float scales[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
};

void main() {
    uint row = group_index();
    if (row >= rows) return;
    uint quads = width / 4;
    float largest = 0.0;
    bool lost = false;
    for (uint c = gl_LocalInvocationID.x; c < quads; c += gl_WorkGroupSize.x) {
        vec4 x = vec4(source[row * quads + c]);
        largest = max(largest, largest_of(x));
        lost = lost || any(isnan(x));
    }
    largest = subgroupMax(largest);
    lost = subgroupAny(lost);
    float steps = largest > 0.0 ? 127.0 / largest : 0.0;
    for (uint c = gl_LocalInvocationID.x; c < quads; c += gl_WorkGroupSize.x) {
        ivec4 q = ivec4(clamp(roundEven(vec4(source[row * quads + c]) * steps), -127.0, 127.0)) & 0xff;
        result[row * quads + c] = uint(q.x | q.y << 8 | q.z << 16 | q.w << 24);
    }
    if (subgroupElect()) scales[row] = lost ? uintBitsToFloat(0x7fc00000u) : largest / 127.0;
}
