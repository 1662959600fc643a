// Transposes rows into panels of PANEL_COLUMNS, for cluster/nearest_uniform.
//
// Source [rows, width] f32
// Out    [panels, width, PANEL_COLUMNS] f32, padded with the last row
#version 460
#extension GL_GOOGLE_include_directive : require
#include "shared/index.glsl"

layout(local_size_x = 64) in;

layout(set = 0, binding = 0) readonly buffer Source { float source[]; };
layout(set = 0, binding = 1) writeonly buffer Out { float result[]; };

layout(push_constant) uniform Push {
    uint rows;
    uint width;
};

void main() {
    uint at = global_index();
    uint panel = at / PANEL_COLUMNS / width;
    if (panel * PANEL_COLUMNS >= rows) return;
    uint row = min(panel * PANEL_COLUMNS + at % PANEL_COLUMNS, rows - 1);
    result[at] = source[row * width + at / PANEL_COLUMNS % width];
}
