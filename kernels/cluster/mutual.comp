// Sort keys of tokens: fewest mutual nearest neighbors in earlier views first, evenly spread.
//
// Nearest [views, pitch] u32, patch of that view nearest to each token
// Keys    [views * patches] u32, number of neighbors above the token's reversed bits
//
// Two tokens are mutual neighbors if each is nearest to the other in the other's view. The reversed
// bits of an index order tokens so that the first of any number are spread (van der Corput). One
// invocation owns one token.
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Nearest { uint nearest[]; };
layout(set = 0, binding = 1) writeonly buffer Keys { uint keys[]; };

layout(push_constant) uniform Push {
    uint views;
    uint patches;
    uint pitch;
    uint bits;
};

void main() {
    uint token = global_index();
    if (token >= views * patches) return;
    uint view = token / patches, neighbors = 0;
    for (uint other = 0; other < view; other++) {
        uint neighbor = other * patches + nearest[other * pitch + token];
        if (nearest[view * pitch + neighbor] == token % patches) neighbors++;
    }
    keys[token] = neighbors << bits | bitfieldReverse(token) >> (32 - bits);
}
