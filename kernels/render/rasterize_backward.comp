// Computes the gradient of each splat through each of its tiles.
//
// PairIndices [intersections] u32, by tile, near to far
// TileOffsets [tiles + 1] u32
// TileSets    [pairs, 3] u32, of render/project
// Slots       [pairs + 1] u32, first slot of each pair, one per tile, in order
// XyOpacities, Conics, Colors, Depths as in render/rasterize
// Frames      [C, rows, width, channels] f32, of render/rasterize, without normals and tokens
// DFrames     [C, rows, width, channels] f32
// Moments     [capacity, 6] f32, sums over a tile of g (1, e, y, e e, e y, y y), per slot
// DValues     [capacity, 3, 4 or 1] f32, gradients of color and depth, as enabled, per slot
//
// g is the gradient of ln alpha, e = dx - k dy and y = dy, as in render/project. One workgroup owns
// one tile, in runs as in render/rasterize, and writes each slot of its list once. Sums are in the
// order of runs, then lanes. If BATCHED, lanes load and write as many splats at once.
// Source: brush (2024), where the color behind a splat is the frame minus the part blended so far.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#extension GL_KHR_shader_subgroup_vote : require
layout(local_size_x_id = 0) in;
#include "shared/limits.glsl"
#include "shared/splat.glsl"

layout(constant_id = 1) const uint RUNS = 8;
layout(constant_id = 2) const bool COLOR = true;
layout(constant_id = 3) const bool ALPHA = false;
layout(constant_id = 4) const bool DEPTH = false;
layout(constant_id = 5) const bool EXPECTED_DEPTH = false;
layout(constant_id = 6) const bool BATCHED = false;

layout(set = 0, binding = 0) readonly buffer PairIndices { uint pair_indices[]; };
layout(set = 0, binding = 1) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(scalar, set = 0, binding = 2) readonly buffer TileSets { uvec3 tile_sets[]; };
layout(set = 0, binding = 3) readonly buffer Slots { uint slots[]; };
layout(scalar, set = 0, binding = 4) readonly buffer XyOpacities { vec3 xy_opacities[]; };
layout(scalar, set = 0, binding = 5) readonly buffer Conics { vec3 conics[]; };
layout(scalar, set = 0, binding = 6) readonly buffer Colors { vec3 colors[]; };
layout(set = 0, binding = 7) readonly buffer Depths { float depths[]; };
layout(set = 0, binding = 8) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 9) readonly buffer DFrames { float d_frames[]; };
layout(scalar, set = 0, binding = 10) writeonly buffer Moments { vec3 moments[]; };
layout(set = 0, binding = 11) writeonly buffer DValues { float d_values[]; };
layout(push_constant) uniform Push { uvec2 size; uvec2 grid; uint first_tile_row; uint row_count; uint capacity; };

#include "shared/runs.glsl"
#include "shared/batch.glsl"
#include "shared/slots.glsl"

const uint CHANNELS = (COLOR ? 3 : 0) + (ALPHA ? 1 : 0) + (DEPTH ? 1 : 0);
const uint VALUES = (COLOR ? 3 : 0) + (DEPTH ? 1 : 0);

struct Pixel {
    float transmittance; // negative once done
    float behind;        // frame minus the part blended so far, times its gradient
    vec3 d_rgb;
    float d_depth;
    float d_alpha;
};

struct Gradient {
    vec3 first;  // moments 1, e, y
    vec3 second; // e e, e y, y y
    vec3 rgb;
    float depth;
};

struct Splat {
    uint pair;
    vec3 xy_opacity;
    vec3 conic;
    vec4 shade; // color and depth
};

const Gradient NOTHING = Gradient(vec3(0), vec3(0), vec3(0), 0);

Pixel pixels[RUNS];
uint open = 0; // own pixels that are not done

vec3 load(uint at) { return vec3(d_frames[at], d_frames[at + 1], d_frames[at + 2]); }

Pixel pixel(uvec2 position) {
    Pixel pixel = Pixel(-1, 0, vec3(0), 0, 0);
    if (any(greaterThanEqual(position, size))) return pixel;
    pixel.transmittance = 1;
    uint row = gl_WorkGroupID.z * row_count + position.y - first_tile_row * TILE;
    uint at = (row * size.x + position.x) * CHANNELS;
    if (COLOR) {
        pixel.d_rgb = load(at);
        pixel.behind = dot(vec3(frames[at], frames[at + 1], frames[at + 2]), pixel.d_rgb);
        at += 3;
    }
    float alpha = 0;
    if (ALPHA) {
        alpha = frames[at];
        pixel.d_alpha = d_frames[at];
        pixel.behind += alpha * pixel.d_alpha;
        at += 1;
    }
    if (DEPTH) pixel.d_depth = d_frames[at];
    if (DEPTH && !EXPECTED_DEPTH) pixel.behind += frames[at] * pixel.d_depth;
    // Summed over splats, the quotient's two gradient terms cancel.
    if (EXPECTED_DEPTH) {
        pixel.d_depth = alpha > LEAST_DIVISOR ? pixel.d_depth / alpha : 0;
        pixel.d_alpha -= pixel.d_depth * frames[at];
    }
    return pixel;
}

void put(uint slot, Gradient gradient) {
    if (slot >= capacity) return;
    moments[2 * slot] = gradient.first;
    moments[2 * slot + 1] = gradient.second;
    if (COLOR) {
        for (uint c = 0; c < 3; c++) d_values[slot * VALUES + c] = gradient.rgb[c];
    }
    if (DEPTH) d_values[slot * VALUES + VALUES - 1] = gradient.depth;
}

// Moves a pixel past a splat of unclamped alpha `full`; accumulates the splat's gradient.
void share(inout Pixel pixel, float full, Sight sight, vec3 rgb, float depth, inout Gradient sum) {
    float alpha = min(ALPHA_MAX, full);
    bool seen = alpha >= ALPHA_MIN && pixel.transmittance > 0;
    float left = pixel.transmittance * (1 - alpha);
    bool drawn = seen && left > TRANSMITTANCE_MIN;
    float weight = drawn ? alpha * pixel.transmittance : 0;
    float value = weight * (dot(rgb, pixel.d_rgb) + depth * pixel.d_depth + pixel.d_alpha);
    pixel.behind -= value;
    float g = drawn && full <= ALPHA_MAX ? value - pixel.behind * alpha / (1 - alpha) : 0;
    vec3 moment = g * vec3(1, sight.e, sight.y);
    sum.first += moment;
    sum.second += vec3(moment.yz * sight.e, moment.z * sight.y);
    if (COLOR) sum.rgb += weight * pixel.d_rgb;
    if (DEPTH) sum.depth += weight * pixel.d_depth;
    pixel.transmittance = drawn ? left : seen ? -pixel.transmittance : pixel.transmittance;
    if (seen && !drawn) open--;
}

// Moves all pixels past a splat; returns its gradient.
Gradient gradient(Falloff splat, vec4 shade) {
    Gradient sum = NOTHING;
    bool reached = false;
    for (uint run = 0; run < RUNS; run++) {
        Sight sight;
        if (sees(splat, run, sight)) {
            share(pixels[run], alpha(splat, sight), sight, shade.rgb, shade.w, sum);
            reached = true;
        }
    }
    if (subgroupAny(reached)) {
        sum.first = subgroupAdd(sum.first);
        sum.second = subgroupAdd(sum.second);
        if (COLOR) sum.rgb = subgroupAdd(sum.rgb);
        if (DEPTH) sum.depth = subgroupAdd(sum.depth);
    }
    return sum;
}

Splat splat(uint pair) {
    return Splat(pair, xy_opacities[pair], conics[pair], vec4(COLOR ? colors[pair] : vec3(0), DEPTH ? depths[pair] : 0));
}

// Returns where the batches not processed start. Loads batches ahead, as render/rasterize.
uint process_batches(uint first, uint end) {
    uint i = first + gl_LocalInvocationID.x, last = end - 1;
    Splat next = splat(pair_indices[min(i, last)]);
    uint pair = pair_indices[min(i + LANES, last)];
    for (; first < end && subgroupAny(open > 0); first += LANES, i += LANES) {
        Splat own = next;
        next = splat(pair);
        pair = pair_indices[min(i + 2 * LANES, last)];
        uint at, count = put(falloff(own.xy_opacity, own.conic), own.shade, i < end, at);
        subgroupBarrier();
        Gradient sum = NOTHING;
        for (uint n = 0; n < count && subgroupAny(open > 0); n++) {
            Gradient total = gradient(batch_falloff(n), batch_shade(n));
            if (n == at) sum = total;
        }
        if (i < end) put(slot_of(own.pair), sum);
    }
    return first;
}

void main() {
    for (uint run = 0; run < RUNS; run++) {
        pixels[run] = pixel(position(run));
        if (pixels[run].transmittance > 0) open++;
    }

    uint list = (gl_WorkGroupID.z * grid.y + tile().y) * grid.x + tile().x;
    uint i = tile_offsets[list], end = tile_offsets[list + 1];
    if (BATCHED && i < end) i = process_batches(i, end);
    for (; !BATCHED && i < end && subgroupAny(open > 0); i++) {
        Splat own = splat(pair_indices[i]);
        Gradient sum = gradient(falloff(own.xy_opacity, own.conic), own.shade);
        if (subgroupElect()) put(slot_of(own.pair), sum);
    }
    // The remaining splats are hidden.
    for (i += gl_LocalInvocationID.x; i < end; i += LANES) put(slot_of(pair_indices[i]), NOTHING);
}
