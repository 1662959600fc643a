// Extracts queries, keys or values from a projection: normalizes, rotates, pools and scales them.
//
// Projection   [rows, stride] ELEMENT, columns from `column` on
// Weight, Bias [dim] f32, affine norm over a head's channels; read if NORM
// Rotary       [turned, dim / 2] f32 (cos, sin) per pair; read if ROTATE
// LogCounts    [out_rows] f32, log of the number of pooled rows; [views, out_rows] if OWN, LOWEST
//              for a view's own rows; written if COUNT
// Out          [heads, out_rows, out_dim] ELEMENT, 0 from channel dim on;
//              [heads, sequences, panels, dim, panel] if TRANSPOSE, the last panel padded
//
// One subgroup owns one head of one row of Out, one workgroup SUBGROUPS of them. A lane computes
// two channels at a time. POOL averages POOL x POOL patches, cropped at the view's border.
// Sources: Token Merging (Bolya et al. 2023); RoPE 2D (Su et al. 2021; DA3): half of the channels
// rotate by y, half by x, in pairs a quarter head apart.
#version 460
#pragma element ELEMENT
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"
#include "shared/numbers.glsl"

layout(local_size_x_id = 0) in;

#include "shared/row_statistics.glsl"

layout(constant_id = 1) const bool NORM = false;
layout(constant_id = 2) const bool ROTATE = false;
layout(constant_id = 3) const bool TRANSPOSE = false;
layout(constant_id = 4) const uint POOL = 1;
layout(constant_id = 5) const bool COUNT = false;
layout(constant_id = 6) const uint SUBGROUPS = 1;
layout(constant_id = 7) const uint LEADING = 0; // rows of a view before its patches, if POOL > 1
layout(constant_id = 8) const bool OWN = false;
layout(constant_id = 9) const bool FIRST = false; // the first view is not pooled

layout(set = 0, binding = 0) readonly buffer Projection { ELEMENT projection[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Rotary { vec2 rotary[]; };
layout(set = 0, binding = 4) writeonly buffer Out { ELEMENT result[]; };
layout(set = 0, binding = 5) writeonly buffer LogCounts { float log_counts[]; };

layout(push_constant) uniform Push {
    uint rows;      // of Out that this dispatch writes
    uint heads;
    uint dim;
    uint out_dim;
    uint stride;
    uint column;
    uint first_row; // of Out, of this dispatch
    uint out_rows;
    uint sequence;  // rows
    uint panel;     // rows, if TRANSPOSE
    uint tokens;    // rows of a view
    uint turned;    // leading rows of a view that rotate
    uint columns;   // patches across a view, if POOL > 1
    uint views;     // if OWN
    float scale;
    float eps;
};

uint from;

// Rows of Projection averaged into one row of Out.
struct Group {
    uint first;
    uvec2 size; // patches along x and y
    uint view;  // 0 if POOL is 1
};

Group group_of(uint row) {
    if (POOL == 1) return Group(row, uvec2(1), 0);
    uvec2 patches = uvec2(columns, (tokens - LEADING) / columns);
    uvec2 groups = (patches + POOL - 1) / POOL;
    uint each = LEADING + groups.x * groups.y;
    uint first = row / each * tokens;
    uint view = FIRST ? 1 + (first_row + row - tokens) / each : (first_row + row) / each;
    uint within = row % each;
    if (within < LEADING) return Group(first + within, uvec2(1), view);
    uvec2 at = POOL * uvec2((within - LEADING) % groups.x, (within - LEADING) / groups.x);
    return Group(first + LEADING + at.y * columns + at.x, min(patches - at, uvec2(POOL)), view);
}

uint member(Group group, uint i) { return group.first + i / group.size.x * columns + i % group.size.x; }

float value_of(uint c) { return from_ELEMENT(projection[from + c]); }

// First channel of pair p; the second is dim / 4 further.
uint pair_channel(uint p) {
    uint quarter = dim / 4;
    return p < quarter ? p : p + quarter;
}

void store(uint head, uint row, uint channel, float value) {
    if (TRANSPOSE) {
        uint sequences = out_rows / sequence;
        uint panels = (sequence + panel - 1) / panel;
        uint within = row % sequence;
        uint at = ((head * sequences + row / sequence) * panels + within / panel) * dim + channel;
        result[at * panel + within % panel] = to_ELEMENT(value);
    } else {
        result[(head * out_rows + row) * out_dim + channel] = to_ELEMENT(value);
    }
}

vec2 pair(Statistics statistics, uint row, uint head, uint p) {
    uint c = pair_channel(p);
    uint apart = dim / 4;
    from = row * stride + column + head * dim;
    vec2 x = vec2(value_of(c), value_of(c + apart));
    if (NORM) {
        x = vec2(normed(statistics, x.x), normed(statistics, x.y));
        x = x * vec2(weight[c], weight[c + apart]) + vec2(bias[c], bias[c + apart]);
    }
    // Pooled views are whole, so they begin with row 0.
    uint token = ((POOL == 1 ? first_row : 0) + row) % tokens;
    if (ROTATE && token < turned) {
        vec2 turn = rotary[token * (dim / 2) + p];
        x = vec2(x.x * turn.x - x.y * turn.y, x.y * turn.x + x.x * turn.y);
    }
    return x;
}

void main() {
    uint index = group_index() * SUBGROUPS + gl_SubgroupID;
    if (index >= rows * heads) return;
    uint row = index / heads;
    uint head = index % heads;
    Group group = group_of(row);
    uint members = group.size.x * group.size.y;
    Statistics statistics[POOL * POOL];
    if (NORM) {
        for (uint i = 0; i < members; i++) {
            from = member(group, i) * stride + column + head * dim;
            statistics[i] = row_statistics(dim, eps);
        }
    }
    for (uint p = gl_SubgroupInvocationID; p < dim / 2; p += gl_SubgroupSize) {
        vec2 x = pair(statistics[0], member(group, 0), head, p);
        for (uint i = 1; i < members; i++) x += pair(statistics[i], member(group, i), head, p);
        if (POOL > 1) x /= float(members);
        x *= scale;
        store(head, first_row + row, pair_channel(p), x.x);
        store(head, first_row + row, pair_channel(p) + dim / 4, x.y);
    }
    if (!TRANSPOSE) {
        for (uint c = dim + gl_SubgroupInvocationID; c < out_dim; c += gl_SubgroupSize) {
            store(head, first_row + row, c, 0.0);
        }
    }
    if (COUNT && head == 0) {
        for (uint v = gl_SubgroupInvocationID; v < (OWN ? views : 1); v += gl_SubgroupSize) {
            bool own = OWN && v == group.view;
            log_counts[v * out_rows + first_row + row] = own ? LOWEST : log(float(members));
        }
    }
}
