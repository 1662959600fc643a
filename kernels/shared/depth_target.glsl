// Frames [C, pixels, 5] f32: RGB, alpha, expected depth.
const uint CHANNELS = 5;
const float LEAST_ALPHA = 0.5; // pixels below have no depth

// Whether pixel `at` of the frames and its target, 0 if unknown, compare.
#define has_depth(target, at) (target > 0 && frames[CHANNELS * (at) + 3] >= LEAST_ALPHA && frames[CHANNELS * (at) + 4] > 0)
