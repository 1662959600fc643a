// What the render kernels agree on: gsplat 1.5.3's thresholds, and the record of the tiles that a Gaussian touches,
// which render/project writes once and the others only read.
#include "shared/numbers.glsl"

const float ALPHA_MIN = 1.0 / 255.0;      // weaker contributions are skipped
const float ALPHA_MAX = 0.999;            // stronger ones are clamped
const float TRANSMITTANCE_MIN = 1e-4;     // a pixel is done before it would get here
const float BLUR = 0.3;                   // pixels^2 added to both variances: a Gaussian is never thinner than a pixel
const float LONG = 1e8;                   // pixels: powers of what is longer would overflow
const float LONGEST = 1e15;               // pixels: what is longer is the same in every picture, unless its centre is as far off
const float FAR_OFF = 256;                // pixels beyond a picture from which on a splat's place is its ridge's
const float MARGIN = 0.15;                // of a picture's size, how far off it a slope may be where a Gaussian is projected
const uint CULLED_DEPTH = INFINITY_BITS;  // what is not drawn sorts behind everything

// The row at which the x of a splat's place lies on its ridge, where alpha is largest in a row: its centre's, or, so that
// a long needle's ridge is exact where it is seen, the picture's nearest.
float ridge_row(float y, uint height) { return y < -FAR_OFF || y > height + FAR_OFF ? clamp(y, 0, height) : y; }

// All tiles of a rectangle, or, where it has at most 32, those whose bit is set (row-major).
struct TileSet {
    uvec2 first;
    uvec2 size;
    uint mask;
};

uint tile_count(TileSet tiles) { return tiles.mask != 0 ? bitCount(tiles.mask) : tiles.size.x * tiles.size.y; }

uvec3 pack(TileSet tiles) {
    return uvec3(tiles.first.x | tiles.first.y << 16, tiles.size.x | tiles.size.y << 16, tiles.mask);
}

TileSet unpack(uvec3 words) {
    return TileSet(uvec2(words.x & 0xffff, words.x >> 16), uvec2(words.y & 0xffff, words.y >> 16), words.z);
}
