// The window of SSIM, 11 taps of a Gaussian of sigma 1.5, over a run of RUN values that one invocation owns along a line.
const int RADIUS = 5;
const float WINDOW[2 * RADIUS + 1] = float[](0.00102838012, 0.00759875821, 0.0360007733, 0.109360687, 0.213005543,
    0.266011715, 0.213005543, 0.109360687, 0.0360007733, 0.00759875821, 0.00102838012);
const int REACH = int(RUN) + 2 * RADIUS; // values that a run sees, from RADIUS before its first on

// Adds the value at place `k` of the reach to the sums of the run.
void add_tap(inout vec4 sums[RUN], int k, vec4 value) {
    [[unroll]] for (int p = 0; p < RUN; p++) {
        int tap = k - p;
        if (tap >= 0 && tap <= 2 * RADIUS) sums[p] += WINDOW[tap] * value;
    }
}
