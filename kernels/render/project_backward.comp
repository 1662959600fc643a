// Propagates splat gradients to Gaussians and cameras.
//
// Means, Scales, Quats, Opacities, Cameras as in render/project
// Conics      [N, C, 3] f32, of render/project
// DPairs      [N, C, 10] f32, of render/color_backward, 0 if culled
// DMeans, DScales, DQuats, DOpacities as the Gaussians, accumulated if SCENE_GRADIENTS
// DCameras    [workgroups, C, 10] f32, sums over a workgroup's Gaussians, written if
//             CAMERA_GRADIENTS: w, v of camera-to-world pose o (exp(w^), v), fx, fy, cx, cy
//
// One invocation owns one Gaussian, one workgroup a subgroup of them. Sums are in the order of
// cameras, then lanes.
// F is the two rows of J W R S, Q the conic's matrix, d the offset from the center. As ln alpha is
// -d'Qd / 2, F's gradient is that of ln alpha times (Qd)(Qd)'F. The completed squares
// Q = [1, -k]'A[1, -k] + [0, 1]'P[0, 1] express Qd by e and y, and QF by A (u - k v) and P v:
// nothing cancels for needles.
#version 460
#extension GL_EXT_scalar_block_layout : require
#extension GL_KHR_shader_subgroup_arithmetic : require
layout(local_size_x_id = 0) in;
#include "shared/camera.glsl"
#include "shared/index.glsl"
#include "shared/lengths.glsl"
#include "shared/pair_gradient.glsl"
#include "shared/rotation.glsl"
#include "shared/splat.glsl"

layout(constant_id = 1) const bool ANTIALIASED = false;
layout(constant_id = 2) const bool SCENE_GRADIENTS = true;
layout(constant_id = 3) const bool CAMERA_GRADIENTS = false;

layout(scalar, set = 0, binding = 0) readonly buffer Means { vec3 means[]; };
layout(scalar, set = 0, binding = 1) readonly buffer Scales { vec3 scales[]; };
layout(set = 0, binding = 2) readonly buffer Quats { vec4 quats[]; };
layout(set = 0, binding = 3) readonly buffer Opacities { float opacities[]; };
layout(set = 0, binding = 4) readonly buffer Cameras { vec4 cameras[]; };
layout(scalar, set = 0, binding = 5) readonly buffer Conics { vec3 conics[]; };
layout(scalar, set = 0, binding = 6) readonly buffer DPairs { PairGradient d_pairs[]; };
layout(scalar, set = 0, binding = 7) buffer DMeans { vec3 d_means[]; };
layout(scalar, set = 0, binding = 8) buffer DScales { vec3 d_scales[]; };
layout(set = 0, binding = 9) buffer DQuats { vec4 d_quats[]; };
layout(set = 0, binding = 10) buffer DOpacities { float d_opacities[]; };
layout(scalar, set = 0, binding = 11) writeonly buffer DCameras { float d_cameras[]; };
layout(push_constant) uniform Push { uint gaussians; uint first_group; uint camera_count; uint width; uint height; };

struct GaussianGradient {
    vec3 mean;
    vec3 scale;
    vec3 turn; // by a small rotation in world space
    float opacity;
};

struct CameraGradient {
    vec3 turn;
    vec3 shift;
    vec2 focal;
    vec2 principal;
};

// Gradients of the splat's rows; u and v come scaled by `unit`.
void to_rows(PairGradient pair, vec3 conic, vec3 u, vec3 v, float unit, out vec3 d_u, out vec3 d_v) {
    float blur = BLUR * unit * unit;
    vec3 minors = cross(u, v);
    vec3 m = (cross(v, minors) + blur * u) / (dot(v, v) + blur); // u - k v
    float ee = conic.x * (conic.x * pair.second.x), ey = conic.x * (conic.z * pair.second.y), yy = conic.z * (conic.z * pair.second.z);
    d_u = (ee * m + ey * v) / unit;
    d_v = (ey * m + yy * v) / unit - conic.y * d_u;
    if (ANTIALIASED) {
        // ln compensation is (ln det F F' - ln det (F F' + BLUR)) / 2, with gradient BLUR Q times
        // F's dual.
        float sharp = dot(minors, minors);
        vec3 dual_u = cross(v, minors) / sharp * unit, dual_v = cross(minors, u) / sharp * unit;
        vec3 across = BLUR * pair.first.x * conic.x * (dual_u - conic.y * dual_v);
        d_u += across;
        d_v += BLUR * pair.first.x * conic.z * dual_v - conic.y * across;
    }
}

void to_gaussian(uint n, uint camera, PairGradient pair, vec3 conic, inout GaussianGradient d_gaussian, inout CameraGradient d_camera) {
    // As in render/project.
    vec4 rows_of_camera[CAMERA_ROWS];
    for (uint r = 0; r < CAMERA_ROWS; r++) rows_of_camera[r] = cameras[CAMERA_ROWS * camera + r];
    mat4x3 view = transpose(mat3x4(rows_of_camera[0], rows_of_camera[1], rows_of_camera[2]));
    vec3 rest = vec3(rows_of_camera[4].w, rows_of_camera[5].w, rows_of_camera[6].w);
    vec2 focal = rows_of_camera[3].xy, principal = rows_of_camera[3].zw;
    vec3 p = mat3(view) * from_center(means[n], view[3], rest);
    vec2 margin = MARGIN * vec2(width, height) / focal, free = p.xy / p.z;
    vec2 slope = clamp(free, -principal / focal - margin, (vec2(width, height) - principal) / focal + margin);
    mat3 rows = transpose(mat3(view) * rotation(unit_vector(quats[n])));
    float limit = LONGEST * p.z / dot(focal, 1 + abs(slope));
    vec3 scale = min(scales[n], limit);
    vec3 along_u = focal.x / p.z * (rows[0] - slope.x * rows[2]), along_v = focal.y / p.z * (rows[1] - slope.y * rows[2]);
    vec3 u = along_u * scale, v = along_v * scale;
    float longest = sqrt(max(dot(u, u), dot(v, v))), unit = longest > LONG ? 1 / longest : 1;
    vec3 d_u, d_v;
    to_rows(pair, conic, u * unit, v * unit, unit, d_u, d_v);

    // Gradients of the rotated axes' rows.
    vec3 d_x = focal.x / p.z * scale * d_u, d_y = focal.y / p.z * scale * d_v, d_z = -slope.x * d_x - slope.y * d_y;
    vec2 d_slope = -vec2(dot(rows[2], d_x), dot(rows[2], d_y));
    vec2 sizes = vec2(dot(u, d_u), dot(v, d_v));
    vec3 turn = vec3(dot(rows[1], d_z) - dot(rows[2], d_y), dot(rows[2], d_x) - dot(rows[0], d_z), dot(rows[0], d_y) - dot(rows[1], d_x));
    bvec2 held = notEqual(slope, free);
    float along = conic.x * pair.first.y;
    vec2 d_center = vec2(along, conic.z * pair.first.z - conic.y * along);
    vec2 d_free = focal * d_center + mix(d_slope, vec2(0), held);
    vec3 d_p = vec3(0, 0, pair.depth) + vec3(d_free, -dot(d_free, free) - sizes.x - sizes.y) / p.z;
    vec3 d_offset = d_p * mat3(view) + pair.rgb;

    d_gaussian.mean += d_offset;
    d_gaussian.scale += mix(along_u * d_u + along_v * d_v, vec3(0), greaterThan(scales[n], vec3(limit)));
    d_gaussian.turn += turn * mat3(view);
    d_gaussian.opacity += pair.first.x / opacities[n];
    vec2 d_limit = mix(vec2(0), d_slope, held);
    d_camera.turn -= cross(p, d_p) + turn;
    d_camera.shift -= mat3(view) * d_offset;
    d_camera.focal += d_center * free + (sizes - d_limit * slope) / focal;
    d_camera.principal += d_center - d_limit / focal;
}

void store(uint camera, CameraGradient gradient) {
    vec3 turn = subgroupAdd(gradient.turn), shift = subgroupAdd(gradient.shift);
    vec4 lens = vec4(subgroupAdd(gradient.focal), subgroupAdd(gradient.principal));
    uint at = ((first_group + group_index()) * camera_count + camera) * 10;
    if (!subgroupElect() || group_index() * gl_WorkGroupSize.x >= gaussians) return;
    for (uint i = 0; i < 3; i++) d_cameras[at + i] = turn[i];
    for (uint i = 0; i < 3; i++) d_cameras[at + 3 + i] = shift[i];
    for (uint i = 0; i < 4; i++) d_cameras[at + 6 + i] = lens[i];
}

void main() {
    uint n = global_index();
    GaussianGradient sum = GaussianGradient(vec3(0), vec3(0), vec3(0), 0);
    for (uint camera = 0; camera < camera_count; camera++) {
        CameraGradient d_camera = CameraGradient(vec3(0), vec3(0), vec2(0), vec2(0));
        if (n < gaussians) {
            uint pair = n * camera_count + camera;
            PairGradient d_pair = d_pairs[pair];
            bool moved = d_pair.first != vec3(0) || d_pair.second != vec3(0) || d_pair.rgb != vec3(0) || d_pair.depth != 0;
            if (moved) to_gaussian(n, camera, d_pair, conics[pair], sum, d_camera);
        }
        if (CAMERA_GRADIENTS) store(camera, d_camera);
    }
    if (!SCENE_GRADIENTS || n >= gaussians) return;
    d_means[n] += sum.mean;
    d_scales[n] += sum.scale;
    d_opacities[n] += sum.opacity;
    // A small rotation w moves a quaternion q by (0, w) q / 2.
    float size = length_of(quats[n]);
    vec4 turned = quats[n] / size;
    d_quats[n] += 2 / size * vec4(-dot(sum.turn, turned.yzw), turned.x * sum.turn + cross(sum.turn, turned.yzw));
}
