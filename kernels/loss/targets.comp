// Converts 8-bit photos.
//
// Photos  [ceil(count / 4)] u32 of 4 bytes, the first in the lowest bits
// Targets [count] f32, byte / 255
//
// One invocation owns four values.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Photos { uint photos[]; };
layout(set = 0, binding = 1) writeonly buffer Targets { float targets[]; };
layout(push_constant) uniform Push { uint count; };

void main() {
    uint i = global_index();
    if (4 * i >= count) return;
    vec4 values = unpackUnorm4x8(photos[i]);
    for (uint k = 0; k < min(4, count - 4 * i); k++) targets[4 * i + k] = values[k];
}
