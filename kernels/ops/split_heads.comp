// Takes queries, keys or values of every head out of a projection: normalises, rotates and scales them once, and lays
// them out as attention reads them.
//
// Projection [rows, stride] ELEMENT; this part begins at column `column`
// Weight     [dim] f32, affine norm over a head's channels; read where NORM
// Bias       [dim] f32; read where NORM
// Rotary     [turned, dim / 2] (cos, sin) of each rotated pair; read where ROTATE
// Out        [heads, out_rows, out_dim] ELEMENT, channels from dim on zero, or where TRANSPOSE [heads, sequences, panels, dim,
//            panel], panels of rows, the last of a sequence padded
//
// One workgroup (a subgroup) owns one head of one row, two channels a lane at a time. Rotary embedding: RoPE 2D (Su et
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

layout(set = 0, binding = 0) readonly buffer Projection { ELEMENT projection[]; };
layout(set = 0, binding = 1) readonly buffer Weight { float weight[]; };
layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Rotary { vec2 rotary[]; };
layout(set = 0, binding = 4) writeonly buffer Out { ELEMENT result[]; };

layout(push_constant) uniform Push {
    uint rows;
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
    float scale;
    float eps;
};

uint from; // where the head starts in Projection

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

void main() {
    uint group = group_index();
    if (group >= rows * heads) return;
    uint row = group / heads;
    uint head = group % heads;
    uint token = (first_row + row) % tokens;
    uint apart = dim / 4;
    from = row * stride + column + head * dim;
    Statistics statistics;
    if (NORM) statistics = row_statistics(dim, eps);
    for (uint p = gl_LocalInvocationID.x; p < dim / 2; p += gl_WorkGroupSize.x) {
        uint c = pair_channel(p);
        vec2 x = vec2(value_of(c), value_of(c + apart));
        if (NORM) {
            x = vec2(normed(statistics, x.x), normed(statistics, x.y));
            x = x * vec2(weight[c], weight[c + apart]) + vec2(bias[c], bias[c + apart]);
        }
        if (ROTATE && token < turned) {
            vec2 turn = rotary[token * (dim / 2) + p];
            x = vec2(x.x * turn.x - x.y * turn.y, x.y * turn.x + x.x * turn.y);
        }
        x *= scale;
        store(head, first_row + row, c, x.x);
        store(head, first_row + row, c + apart, x.y);
    }
    if (!TRANSPOSE) {
        for (uint c = dim + gl_LocalInvocationID.x; c < out_dim; c += gl_WorkGroupSize.x) {
            store(head, first_row + row, c, 0.0);
        }
    }
}
