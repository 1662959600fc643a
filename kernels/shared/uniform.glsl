// Loads at subgroup-uniform addresses, for CPU drivers.
//
// CPU drivers load divergent addresses lane by lane. Here each lane loads a whole vector and keeps
// its value; lavapipe compiles this to one vector load. Reading by address avoids bounds checks.
// Kernels call `find_lanes` first, in one-subgroup workgroups: comparisons inside a loop would not
// be constants. Loops test at their end, because lavapipe otherwise runs an extra masked pass with
// all loads.
#extension GL_EXT_buffer_reference : require
#extension GL_EXT_control_flow_attributes : require
#extension GL_EXT_scalar_block_layout : require
#extension GL_EXT_shader_explicit_arithmetic_types_int64 : require
#extension GL_KHR_shader_subgroup_basic : require

layout(buffer_reference, scalar, buffer_reference_align = 4) readonly buffer Values { float values[]; };
layout(buffer_reference, scalar, buffer_reference_align = 4) readonly buffer Words { uint words[]; };

uint lane;
bool is_lane[gl_WorkGroupSize.x];

void find_lanes() {
    lane = gl_SubgroupInvocationID;
    [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) is_lane[i] = lane == i;
}

// The lane's value of a vector that starts at `first` behind `address`.
float vector_at(uint64_t address, uint first) {
    float mine = 0.0;
    [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) {
        float value = Values(address).values[first + i];
        mine = mix(mine, value, is_lane[i]);
    }
    return mine;
}

// The lane's word; `lanes` neighbors share each, `stride` words apart.
uint shared_word_at(uint64_t address, uint first, uint lanes, uint stride) {
    uint mine = 0;
    [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) {
        uint word = Words(address).words[first + i / lanes * stride];
        mine = mix(mine, word, is_lane[i]);
    }
    return mine;
}
