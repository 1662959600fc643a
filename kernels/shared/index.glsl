// Linear indices of 1-D dispatches, possibly folded to 2-D or split by a base group.
#include "shared/limits.glsl"

uint group_index() { return gl_WorkGroupID.y * GROUP_FOLD + gl_WorkGroupID.x; }

// A macro: gl_WorkGroupSize is 1 until the kernel declares its layout, after its includes.
#define global_index() (group_index() * gl_WorkGroupSize.x + gl_LocalInvocationID.x)
