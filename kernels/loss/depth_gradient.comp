// Computes the gradient of a depth loss by the frames, and sums the loss.
//
// Frames, Targets as of loss/depth_sums
// Lines   [first + C, 5] f32, sums of loss/depth_sums over its groups
// Weight  [1] f32, factor of the gradient
// DColors [C, pixels, 3] f32, gradient by RGB
// DFrames [C, pixels, 5] f32: DColors, 0, gradient by depth
// Sums    [C, groups] f32, of the loss
//
// The loss is the mean of |y - (a t + b)| over pixels with targets t and inverse depth y. If
// FITTED, a and b are the least squares line, constants of the gradient, and without a rising line
// there is no loss; else 1 and 0. One subgroup owns RUN pixels a lane.
#version 460
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
layout(constant_id = 1) const uint RUN = 8;
layout(constant_id = 2) const bool FITTED = false;
#include "shared/index.glsl"

layout(set = 0, binding = 0) readonly buffer Frames { float frames[]; };
layout(set = 0, binding = 1) readonly buffer Targets { float targets[]; };
layout(set = 0, binding = 2) readonly buffer Lines { float lines[]; };
layout(set = 0, binding = 3) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 4) readonly buffer DColors { float d_colors[]; };
layout(set = 0, binding = 5) writeonly buffer DFrames { float d_frames[]; };
layout(set = 0, binding = 6) writeonly buffer Sums { float sums[]; };
layout(push_constant) uniform Push { uint cameras; uint pixels; uint groups; uint first; };
#include "shared/depth_target.glsl"

const float LEAST_SPREAD = 1e-5; // variance over mean square of targets below which no line fits

// Returns slope and offset of a photo's line, and the factor of its sums.
vec3 line(uint camera) {
    float n = lines[5 * camera], t = lines[5 * camera + 1], y = lines[5 * camera + 2];
    float tt = lines[5 * camera + 3], ty = lines[5 * camera + 4];
    if (!(n > 0)) return vec3(0);
    if (!FITTED) return vec3(1, 0, 1 / n);
    float spread = tt - t / n * t, slope = (ty - t / n * y) / spread;
    if (!(spread > LEAST_SPREAD * tt && slope > 0)) return vec3(0);
    return vec3(slope, (y - slope * t) / n, 1 / n);
}

void main() {
    uint camera = group_index() / groups, group = group_index() % groups;
    if (camera >= cameras) return;
    vec3 fit = line(first + camera);
    float sum = 0;
    for (uint p = 0; p < RUN; p++) {
        uint pixel = (group * RUN + p) * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
        if (pixel >= pixels) break;
        uint i = camera * pixels + pixel;
        float t = targets[i], d_depth = 0;
        if (has_depth(t, i)) {
            float y = 1 / frames[CHANNELS * i + 4], off = y - (fit.x * t + fit.y);
            sum += fit.z * abs(off);
            d_depth = -weight[0] * fit.z * sign(off) * y * y;
        }
        for (uint c = 0; c < 3; c++) d_frames[CHANNELS * i + c] = d_colors[3 * i + c];
        d_frames[CHANNELS * i + 3] = 0;
        d_frames[CHANNELS * i + 4] = d_depth;
    }
    float all = subgroupAdd(sum);
    if (gl_LocalInvocationID.x == 0) sums[camera * groups + group] = all;
}
