// Projects Gaussians to several cameras and finds the tiles they touch.
//
// Means       [N, 3] f32, world
// Scales      [N, 3] f32, standard deviations, world
// Quats       [N, 4] f32, wxyz, any length
// Opacities   [N] f32
// ShCoeffs    [N, (SH_DEGREE + 1)^2, 3] f32
// Cameras     [C, 2, 4, 4] f32, see shared/camera
// XyOpacities [N, C, 3] f32, place (x of center or ridge, y of center), pixels, and opacity
// Conics      [N, C, 3] f32, (A, k, P)
// Colors      [N, C, 3] f32
// Depths      [N, C] u32, bits of camera z
// TileSets    [N, C, 3] u32, see shared/splat
// Indices     [N, C] u32, pairs
//
// Pairs nearer than `near` are culled.
// A conic is the inverse covariance in completed squares, d' conic d = A (dx - k dy)^2 + P dy^2:
// never negative, without cancellation for needles. dx - k dy counts from the splat's ridge.
// Source: EWA splatting (Zwicker et al. 2001) with the constants of gsplat 1.5.3.
#version 460
#extension GL_EXT_scalar_block_layout : require
layout(local_size_x = 64) in;
#include "shared/camera.glsl"
#include "shared/double_float.glsl"
#include "shared/index.glsl"
#include "shared/lengths.glsl"
#include "shared/rotation.glsl"
#include "shared/spherical_harmonics.glsl"
#include "shared/splat.glsl"
#include "shared/ridge.glsl"

layout(constant_id = 1) const bool COLOR = true;
layout(constant_id = 2) const uint SH_DEGREE = 0;
layout(constant_id = 3) const bool ANTIALIASED = false;

layout(scalar, set = 0, binding = 0) readonly buffer Means { vec3 means[]; };
layout(scalar, set = 0, binding = 1) readonly buffer Scales { vec3 scales[]; };
layout(set = 0, binding = 2) readonly buffer Quats { vec4 quats[]; };
layout(set = 0, binding = 3) readonly buffer Opacities { float opacities[]; };
layout(scalar, set = 0, binding = 4) readonly buffer ShCoeffs { vec3 sh_coeffs[]; };
layout(set = 0, binding = 5) readonly buffer Cameras { vec4 cameras[]; };
layout(scalar, set = 0, binding = 6) writeonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 7) writeonly buffer Conics { vec3 conics[]; };
layout(scalar, set = 0, binding = 8) writeonly buffer Colors { vec3 colors[]; };
layout(set = 0, binding = 9) writeonly buffer Depths { uint depths[]; };
layout(scalar, set = 0, binding = 10) writeonly buffer TileSets { uvec3 tile_sets[]; };
layout(set = 0, binding = 11) writeonly buffer Indices { uint indices[]; };
layout(push_constant) uniform Push { uint pairs; uint first_pair; uint camera_count; uint width; uint height; float near; };

const float FAR = 1e10;
const float EXTENT_MAX = 3.33; // standard deviations at which even opacity 1 falls below ALPHA_MIN

// Least d' conic d over pixel centers from `from` to `to`. The form is convex: the minimum is at
// the center or on an edge facing it.
float nearest(vec3 conic, vec2 center, vec2 place, vec2 from, vec2 to) {
    float row = ridge_row(place.y, height), rise = place.y - row;
    vec2 edge = clamp(center, from, to);
    float along = conic.x * conic.y * (edge.x - place.x) + conic.z * rise;
    float y = clamp(row + along / (conic.x * conic.y * conic.y + conic.z), from.y, to.y);
    float x = clamp(place.x + conic.y * (edge.y - row), from.x, to.x);
    vec2 e = vec2(edge.x - place.x - conic.y * (y - row), x - place.x - conic.y * (edge.y - row));
    vec2 dy = vec2(y, edge.y) - place.y;
    vec2 q = conic.x * e * e + conic.z * dy * dy;
    return min(q.x, q.y);
}

// Tiles within `radii` of the center; if few, those where d' conic d falls to `reach` (alpha to
// ALPHA_MIN). The margin covers rounding in images of 2^15 pixels a side.
TileSet touched(vec2 center, vec2 place, vec2 radii, vec3 conic, float reach) {
    vec2 grid = (uvec2(width, height) + TILE - 1) / TILE;
    uvec2 first = uvec2(clamp(floor((center - radii) / TILE), vec2(0), grid));
    uvec2 end = uvec2(clamp(ceil((center + radii) / TILE), vec2(0), grid));
    TileSet tiles = TileSet(first, end - min(first, end), 0);
    uint area = tiles.size.x * tiles.size.y;
    if (area == 0 || area > 32) return tiles;
    for (uint t = 0; t < area; t++) {
        vec2 corner = vec2(first + uvec2(t % tiles.size.x, t / tiles.size.x)) * TILE;
        if (nearest(conic, center, place, corner + 0.5, corner + TILE - 0.5) <= reach + 0.1) tiles.mask |= 1u << t;
    }
    if (tiles.mask == 0) tiles.size = uvec2(0);
    return tiles;
}

const uint COEFFS = (SH_DEGREE + 1) * (SH_DEGREE + 1);

void add_bands(uint n, vec3 direction, inout vec3 sum) {
    float basis[16];
    spherical_harmonics(SH_DEGREE, direction, basis);
    for (uint k = 1; k < COEFFS; k++) sum += basis[k] * sh_coeffs[n * COEFFS + k];
}

vec3 color(uint n, vec3 offset) {
    vec3 sum = 0.5 + SH_0 * sh_coeffs[n * COEFFS];
    if (SH_DEGREE > 0) add_bands(n, unit_vector(offset), sum);
    return max(sum, 0);
}

// Writes the splat of Gaussian n and returns its tiles, none if culled. Comparisons reject NaN.
TileSet project(uint n, uint camera, uint pair) {
    const TileSet none = TileSet(uvec2(0), uvec2(0), 0);
    vec4 rows_of_camera[CAMERA_ROWS];
    for (uint r = 0; r < CAMERA_ROWS; r++) rows_of_camera[r] = cameras[CAMERA_ROWS * camera + r];
    mat4x3 view = transpose(mat3x4(rows_of_camera[0], rows_of_camera[1], rows_of_camera[2]));
    vec3 rest = vec3(rows_of_camera[4].w, rows_of_camera[5].w, rows_of_camera[6].w);
    vec2 focal = rows_of_camera[3].xy, principal = rows_of_camera[3].zw;
    vec3 offset = from_center(means[n], view[3], rest);
    vec3 p = mat3(view) * offset;
    depths[pair] = CULLED_DEPTH;
    if (!(p.z >= near && p.z <= FAR)) return none;

    // Rows of J W R S; J's slope is clamped to MARGIN beyond the image.
    vec2 margin = MARGIN * vec2(width, height) / focal;
    vec2 slope = clamp(p.xy / p.z, -principal / focal - margin, (vec2(width, height) - principal) / focal + margin);
    mat3 axes = mat3(view) * rotation(unit_vector(quats[n]));
    mat3 rows = transpose(axes);
    vec3 scale = min(scales[n], LONGEST * p.z / dot(focal, 1 + abs(slope)));
    vec3 u = focal.x / p.z * (rows[0] - slope.x * rows[2]) * scale;
    vec3 v = focal.y / p.z * (rows[1] - slope.y * rows[2]) * scale;
    float longest = sqrt(max(dot(u, u), dot(v, v))), unit = longest > LONG ? 1 / longest : 1;
    u *= unit;
    v *= unit;

    // Sums of squares (Cauchy-Binet): ac - b^2 cancels for needles.
    vec3 minors = cross(u, v);
    float blur = BLUR * unit * unit;
    float sharp = dot(minors, minors), trace = dot(u, u) + dot(v, v);
    float det = sharp + blur * trace + blur * blur;
    float xx = dot(u, u) + blur, xy = dot(u, v), yy = dot(v, v) + blur;
    vec3 conic = vec3(yy / det * unit * unit, xy / yy, unit * unit / yy);

    float opacity = opacities[n];
    if (ANTIALIASED) opacity *= sqrt(sharp / det);
    if (!(opacity >= ALPHA_MIN)) return none;
    float reach = 2 * log(255 * opacity);
    vec2 radii = ceil(min(EXTENT_MAX, sqrt(reach)) * sqrt(vec2(xx, yy)) / unit);
    vec2 center = focal * p.xy / p.z + principal;
    if (!(all(greaterThan(center + radii, vec2(0))) && all(lessThan(center - radii, vec2(width, height))))) return none;
    vec2 place = center, beyond = max(-center, center - vec2(width, height));
    if (max(beyond.x, beyond.y) > FAR_OFF) {
        find_ridge(rows_of_camera, uvec2(width, height), means[n], scale, quats[n], place, conic);
    }
    TileSet tiles = touched(center, place, radii, conic, reach);
    if (tile_count(tiles) == 0) return none;

    depths[pair] = floatBitsToUint(p.z);
    xy_opacities[pair] = vec3(place, opacity);
    conics[pair] = conic;
    if (COLOR) colors[pair] = color(n, offset);
    return tiles;
}

void main() {
    uint pair = global_index();
    if (pair >= pairs) return;
    indices[pair] = first_pair + pair;
    tile_sets[pair] = pack(project(pair / camera_count, pair % camera_count, pair));
}
