// Rules of the render kernels (gsplat 1.5.3's thresholds), and the tiles of a Gaussian.
#include "shared/numbers.glsl"

const float ALPHA_MIN = 1.0 / 255.0;      // weaker contributions are skipped
const float ALPHA_MAX = 0.999;            // stronger ones are clamped
const float TRANSMITTANCE_MIN = 1e-4;     // a pixel stops before this
const float BLUR = 0.3;                   // pixels^2 added to both variances
const float LONG = 1e8;                   // pixels above which powers overflow
const float LONGEST = 1e15;               // pixels; clamp of longer axes
const float FAR_OFF = 256;                // pixels outside the image; beyond, place is the ridge's
const float MARGIN = 0.15;                // fraction of the image that slopes may exceed it by
const uint CULLED_DEPTH = INFINITY_BITS;  // sorts culled splats last

// Row where a splat's place lies on its ridge, the line of each row's largest alpha. Far outside,
// it is the nearest image row, which keeps needles exact where visible.
float ridge_row(float y, uint height) { return y < -FAR_OFF || y > height + FAR_OFF ? clamp(y, 0, height) : y; }

// Tiles of a rectangle; a nonzero mask selects among at most 32, row-major.
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
