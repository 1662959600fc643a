// Moves keys and values to their places by one digit, stably: last part of a radix sort pass.
//
// Keys, Values             [capacity] u32, the first item_count[0] in use
// ItemCount                [1] u32
// DigitOffsets             [256, blocks] u32, prefix sums of ops/sort_count
// SortedKeys, SortedValues [capacity] u32
//
// One workgroup owns one block of keys and moves a subgroup of keys at a time, in order.
// Source: ballot ranks of Onesweep (Adinets and Merrill 2022, section 3.4), without look-back.
#version 460
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x_id = 0) in;
#include "shared/blocks.glsl"

layout(constant_id = 1) const uint ROUNDS = 1; // items per lane whose loads overlap

layout(set = 0, binding = 0) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1) readonly buffer Values { uint values[]; };
layout(set = 0, binding = 2) readonly buffer ItemCount { uint item_count[]; };
layout(set = 0, binding = 3) readonly buffer DigitOffsets { uint digit_offsets[]; };
layout(set = 0, binding = 4) writeonly buffer SortedKeys { uint sorted_keys[]; };
layout(set = 0, binding = 5) writeonly buffer SortedValues { uint sorted_values[]; };
layout(push_constant) uniform Push { uint shift; uint mask; uint blocks; };

shared uint next[RADIX];

uvec4 peers(uint digit, uvec4 lanes) {
    for (uint bit = 1; bit <= mask; bit <<= 1) {
        bool set = (digit & bit) != 0;
        uvec4 ones = subgroupBallot(set);
        lanes &= set ? ones : ~ones;
    }
    return lanes;
}

// Moves one item per lane inside to the next places of their digits.
void move(uint key, uint value, bool inside) {
    uint digit = key >> shift & mask;
    uvec4 equal = peers(digit, subgroupBallot(inside));
    uint rank = subgroupBallotExclusiveBitCount(equal);
    uint place = 0;
    if (inside && rank == 0) {
        place = next[digit];
        next[digit] = place + subgroupBallotBitCount(equal);
    }
    subgroupBarrier(); // orders writes before the next round's reads
    place = subgroupShuffle(place, subgroupBallotFindLSB(equal)) + rank;
    if (inside) {
        sorted_keys[place] = key;
        sorted_values[place] = value;
    }
}

void main() {
    for (uint d = gl_SubgroupInvocationID; d < RADIX; d += gl_SubgroupSize) {
        next[d] = digit_offsets[d * blocks + group_index()];
    }
    subgroupBarrier();
    uvec2 range = block_range(item_count[0], blocks);
    for (uint first = range.x; first < range.y; first += ROUNDS * gl_SubgroupSize) {
        uint own_keys[ROUNDS];
        uint own_values[ROUNDS];
        for (uint r = 0; r < ROUNDS; r++) {
            uint i = first + r * gl_SubgroupSize + gl_SubgroupInvocationID;
            own_keys[r] = i < range.y ? keys[i] : 0;
            own_values[r] = i < range.y ? values[i] : 0;
        }
        for (uint r = 0; r < ROUNDS; r++) {
            bool inside = first + r * gl_SubgroupSize + gl_SubgroupInvocationID < range.y;
            move(own_keys[r], own_values[r], inside);
        }
    }
}
