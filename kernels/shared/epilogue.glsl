// Epilogue of a linear layer: result = residual + gamma * activation(sum + bias).
#include "shared/gelu.glsl"

layout(constant_id = 1) const uint ACTIVATION = 0; // 0 none, 1 GELU (erf), 2 SwiGLU
layout(constant_id = 2) const bool SCALE = false;
layout(constant_id = 3) const bool ADD = false;

layout(set = 0, binding = 2) readonly buffer Bias { float bias[]; };
layout(set = 0, binding = 3) readonly buffer Gamma { float gamma[]; };
layout(set = 0, binding = 4) readonly buffer Residual { float residual[]; };
layout(set = 0, binding = 5) buffer Out { OUTPUT result[]; };

vec4 bias_of(uint quad, uint columns) {
    vec4 offset = vec4(bias[4 * quad], 0.0, 0.0, 0.0);
    [[unroll]] for (uint c = 1; c < 4; c++) offset[c] = 4 * quad + c < columns ? bias[4 * quad + c] : 0.0;
    return offset;
}

void store(uint at, uint column, float value) {
    if (ACTIVATION == 1) value = gelu(value);
    if (SCALE) value *= gamma[column];
    if (ADD) value += residual[at];
    result[at] = to_OUTPUT(value);
}

// For four biased sums, except past the last column.
void finish(vec4 v, uint row, uint quad, uint columns) {
    if (ACTIVATION == 2) {
        uint at = row * (columns / 2) + 2 * quad;
        result[at] = to_OUTPUT(silu(v.x) * v.y);
        result[at + 1] = to_OUTPUT(silu(v.z) * v.w);
        return;
    }
    [[unroll]] for (uint c = 0; c < 4; c++) {
        uint column = 4 * quad + c;
        if (column < columns) store(row * columns + column, column, v[c]);
    }
}
