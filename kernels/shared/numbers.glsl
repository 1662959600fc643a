const uint INFINITY_BITS = 0x7f800000u; // f32 +infinity; larger bits are NaN
const float LOWEST = -1e30; // below every score; finite, so differences are never NaN
const float LEAST_DIVISOR = 1e-10; // lower bound of divisors
const float SQRT_HALF = 0.70710678;
