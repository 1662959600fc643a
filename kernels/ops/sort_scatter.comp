// Moves each key and its value to its place by one digit, equal digits in their order: last part of a radix sort pass.
//
// keys, values [capacity], the first item_count[0] of them in use; digit_offsets [256, blocks], the prefix sum of
// sort_count's digit_counts; sorted_keys, sorted_values [capacity].
// One workgroup owns one share of keys and moves it in order, one subgroup of keys at a time.
// Ranks among equal digits by ballots: Adinets and Merrill, Onesweep, 2022, section 3.4, without its look-back.
#version 460
#extension GL_KHR_shader_subgroup_ballot : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(local_size_x_id = 0) in;
#include "shared/blocks.glsl"

layout(set = 0, binding = 0) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1) readonly buffer Values { uint values[]; };
layout(set = 0, binding = 2) readonly buffer ItemCount { uint item_count[]; };
layout(set = 0, binding = 3) readonly buffer DigitOffsets { uint digit_offsets[]; };
layout(set = 0, binding = 4) writeonly buffer SortedKeys { uint sorted_keys[]; };
layout(set = 0, binding = 5) writeonly buffer SortedValues { uint sorted_values[]; };
layout(push_constant) uniform Push { uint shift; uint mask; uint blocks; };

shared uint next[RADIX];

// The lanes among `lanes` whose digit equals this lane's.
uvec4 peers(uint digit, uvec4 lanes) {
    for (uint bit = 1; bit <= mask; bit <<= 1) {
        bool set = (digit & bit) != 0;
        uvec4 ones = subgroupBallot(set);
        lanes &= set ? ones : ~ones;
    }
    return lanes;
}

void main() {
    for (uint d = gl_SubgroupInvocationID; d < RADIX; d += gl_SubgroupSize) {
        next[d] = digit_offsets[d * blocks + group_index()];
    }
    subgroupBarrier();
    uvec2 range = block_range(item_count[0], blocks);
    for (uint first = range.x; first < range.y; first += gl_SubgroupSize) {
        uint i = first + gl_SubgroupInvocationID;
        bool inside = i < range.y;
        uint key = inside ? keys[i] : 0;
        uint digit = key >> shift & mask;
        uvec4 equal = peers(digit, subgroupBallot(inside));
        uint rank = subgroupBallotExclusiveBitCount(equal);
        uint place = 0;
        if (inside && rank == 0) {
            place = next[digit];
            next[digit] = place + subgroupBallotBitCount(equal);
        }
        subgroupBarrier(); // what the leaders write now, others read in the next round
        place = subgroupShuffle(place, subgroupBallotFindLSB(equal)) + rank;
        if (inside) {
            sorted_keys[place] = key;
            sorted_values[place] = values[i];
        }
    }
}
