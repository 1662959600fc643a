// Takes queries, keys or values of every head out of a projection: normalises, rotates and scales them once, and lays
// them out as attention reads them.
//
// Projection [rows, stride] ELEMENT; this part begins at column `column`
// Weight     [dim] f32, affine norm over a head's channels; read where NORM
// Bias       [dim] f32; read where NORM
// Rotary     [turned, dim / 2] (cos, sin) of each rotated pair; read where ROTATE
// LogCounts  [out_rows] f32: the logarithm of how many rows each is the mean of; written where COUNT
// Out        [heads, out_rows, out_dim] ELEMENT, channels from dim on zero, or where TRANSPOSE [heads, sequences, panels, dim,
//            panel], panels of rows, the last of a sequence padded
//
// One workgroup (a subgroup) owns one head of one row of Out, two channels a lane at a time. Such a row is one of Projection, or where
// POOL is above 1 the mean of a group of POOL x POOL patches, fewer at a view's border (Token Merging, Bolya et al. 2023). Rotary embedding: RoPE 2D (Su et
// al. 2021; DA3), half of the channels with y and half with x, pairs half a half apart.
#version 460
#pragma element ELEMENT
#extension GL_GOOGLE_include_directive : require
#extension GL_KHR_shader_subgroup_arithmetic : require
#include "shared/index.glsl"

layout(local_size_x_id = 0) in;

#include "shared/row_statistics.glsl"

layout(constant_id = 1) const bool NORM = false;
layout(constant_id = 2) const bool ROTATE = false;
layout(constant_id = 3) const bool TRANSPOSE = false;
layout(constant_id = 4) const uint POOL = 1;
layout(constant_id = 5) const bool COUNT = false;

layout(set = 0, binding = 0) readonly buffer Projection { ELEMENT projection[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Rotary { vec2 rotary[]; };
layout(set = 0, binding = 4) writeonly buffer Out { ELEMENT result[]; };
layout(set = 0, binding = 5) writeonly buffer LogCounts { float log_counts[]; };

layout(push_constant) uniform Push {
    uint rows;      // of Out that are written
    uint heads;
    uint dim;
    uint out_dim;
    uint stride;
    uint column;
    uint first_row; // row of Out that this dispatch's row 0 is
    uint out_rows;
    uint sequence;  // rows of one sequence
    uint panel;     // rows that lie side by side, where TRANSPOSE
    uint tokens;    // rows of a view, after which rotations repeat
    uint turned;    // the first rows of a view, which rotate
    uint columns;   // patches of a view from left to right, where POOL is above 1
    uint leading;   // rows of a view before its patches
    float scale;
    float eps;
};

uint from; // where the head starts in the row of Projection

// The rows of Projection that are a row of Out.
struct Group {
    uint first;
    uvec2 size; // patches along x and y
};

Group group_of(uint row) {
    if (POOL == 1) return Group(row, uvec2(1));
    uvec2 patches = uvec2(columns, (tokens - leading) / columns);
    uvec2 groups = (patches + POOL - 1) / POOL;
    uint each = leading + groups.x * groups.y;
    uint view = row / each * tokens;
    uint within = row % each;
    if (within < leading) return Group(view + within, uvec2(1));
    uvec2 at = POOL * uvec2((within - leading) % groups.x, (within - leading) / groups.x);
    return Group(view + leading + at.y * columns + at.x, min(patches - at, uvec2(POOL)));
}

// The i-th of them.
uint member(Group group, uint i) { return group.first + i / group.size.x * columns + i % group.size.x; }

float value_of(uint c) { return from_ELEMENT(projection[from + c]); }

// The first channel of pair p; the second is `dim / 4` further.
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

// Pair p of a row of Projection, normed and rotated.
vec2 pair(Statistics statistics, uint row, uint head, uint p) {
    uint c = pair_channel(p);
    uint apart = dim / 4;
    from = row * stride + column + head * dim;
    vec2 x = vec2(value_of(c), value_of(c + apart));
    if (NORM) {
        x = vec2(normed(statistics, x.x), normed(statistics, x.y));
        x = x * vec2(weight[c], weight[c + apart]) + vec2(bias[c], bias[c + apart]);
    }
    // Pooled views are whole, so that the first of them begins with row 0.
    uint token = ((POOL == 1 ? first_row : 0) + row) % tokens;
    if (ROTATE && token < turned) {
        vec2 turn = rotary[token * (dim / 2) + p];
        x = vec2(x.x * turn.x - x.y * turn.y, x.y * turn.x + x.x * turn.y);
    }
    return x;
}

void main() {
    uint index = group_index();
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
    for (uint p = gl_LocalInvocationID.x; p < dim / 2; p += gl_WorkGroupSize.x) {
        vec2 x = pair(statistics[0], member(group, 0), head, p);
        for (uint i = 1; i < members; i++) x += pair(statistics[i], member(group, i), head, p);
        if (POOL > 1) x /= float(members);
        x *= scale;
        store(head, first_row + row, pair_channel(p), x.x);
        store(head, first_row + row, pair_channel(p) + dim / 4, x.y);
    }
    if (!TRANSPOSE) {
        for (uint c = dim + gl_LocalInvocationID.x; c < out_dim; c += gl_WorkGroupSize.x) {
            store(head, first_row + row, c, 0.0);
        }
    }
    if (COUNT && head == 0 && gl_LocalInvocationID.x == 0) log_counts[first_row + row] = log(float(members));
}
