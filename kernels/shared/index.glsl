// Linear indices of 1-D dispatches, which the recorder may fold to 2-D or split by a base group.
#include "shared/limits.glsl"

uint group_index() { return gl_WorkGroupID.y * GROUP_FOLD + gl_WorkGroupID.x; }

uint global_index() { return group_index() * gl_WorkGroupSize.x + gl_LocalInvocationID.x; }
