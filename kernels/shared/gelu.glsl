// Activations of the feed-forward layers, within about 1e-7.
#include "shared/numbers.glsl"

// Odd polynomial below 1, 1 - exp(-x^2) P(1 / (1 + x/2)) above: Chebyshev fits of degree 6 and 8.
float erf(float x) {
    float z = abs(x);
    float u = z * z;
    float small = z * (1.1283791658 + u * (-0.3761262667 + u * (0.1128359472 + u * (-0.0268542126
        + u * (0.0051890874 + u * (-0.0008016864 + u * 0.0000787588))))));
    float t = 1.0 / (1.0 + 0.5 * z);
    float tail = -0.0001058098 + t * (0.2840830539 + t * (0.2658592558 + t * (0.3217831579 + t * (-0.0356335257
        + t * (0.4505856585 + t * (-0.3554683971 + t * (0.0520138148 + t * 0.0169932313)))))));
    float large = z > 4.0 ? 1.0 : 1.0 - exp(-u) * tail;
    return sign(x) * (z < 1.0 ? small : large);
}

float gelu(float x) { return 0.5 * x * (1.0 + erf(x * SQRT_HALF)); }

float silu(float x) { return x / (1.0 + exp(-x)); }
