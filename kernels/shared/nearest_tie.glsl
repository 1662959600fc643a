// Tie rule of nearest-target kernels, included after the push constants.
//
// The first target wins whose squared distance is at most 1 + tie times the least. Otherwise
// rounding would decide for the mean of two points, midway between both.

float tie_limit(float least) { return least + tie * least; }
