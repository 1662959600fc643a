// Numbers that mean the same in several kernels.
const uint INFINITY_BITS = 0x7f800000u; // of +infinity as f32; more are NaN
const float LOWEST = -1e30; // below every score, and finite, so that a difference of two maxima is never NaN
const float LEAST_DIVISOR = 1e-10; // what divides by less divides by this
const float SQRT_HALF = 0.70710678;
