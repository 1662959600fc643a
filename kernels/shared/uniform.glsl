// Loads at addresses that are the same for all lanes of a subgroup, for drivers of CPUs.
//
// Where each lane has an address of its own, such a driver loads lane by lane. Here all lanes load all values of a vector, and each
// keeps its own: lavapipe makes that the CPU's load of a vector. Buffers are read by address, since a binding costs a comparison
// with its size for each value. A kernel calls `find_lanes` first, in workgroups of one subgroup: a comparison within
// a loop would be no constant to the driver. Loops test at their end, since lavapipe goes through others once more with all lanes
// masked off, and loads all the same.
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

// The lane's value of as many as there are lanes, from the value `first` behind `address` on.
float vector_at(uint64_t address, uint first) {
    float mine = 0.0;
    [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) {
        float value = Values(address).values[first + i];
        mine = mix(mine, value, is_lane[i]);
    }
    return mine;
}

// The lane's word of those from `first` on behind `address`, `stride` words apart, where so many neighbouring lanes share each.
uint shared_word_at(uint64_t address, uint first, uint lanes, uint stride) {
    uint mine = 0;
    [[unroll]] for (uint i = 0; i < gl_WorkGroupSize.x; i++) {
        uint word = Words(address).words[first + i / lanes * stride];
        mine = mix(mine, word, is_lane[i]);
    }
    return mine;
}
