// Finds the first item of each key.
//
// Keys      [capacity] u32, sorted, the first item_count[0] in use
// ItemCount [1] u32
// Starts    [key_count + 1] u32
//
// One invocation owns one key, by binary search.
#version 460
layout(local_size_x = 64) in;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1) readonly buffer ItemCount { uint item_count[]; };
layout(set = 0, binding = 2) writeonly buffer Starts { uint starts[]; };
layout(push_constant) uniform Push { uint key_count; };

void main() {
    uint key = global_index();
    if (key > key_count) return;
    uint from = 0, to = item_count[0];
    while (from < to) {
        uint middle = (from + to) / 2;
        if (keys[middle] < key) {
            from = middle + 1;
        } else {
            to = middle;
        }
    }
    starts[key] = from;
}
