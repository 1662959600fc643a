// SSIM window: a Gaussian of 11 taps, sigma 1.5, over a run of RUN values per invocation.
const int RADIUS = 5;
const float WINDOW[2 * RADIUS + 1] = float[](0.00102838012, 0.00759875821, 0.0360007733, 0.109360687, 0.213005543,
    0.266011715, 0.213005543, 0.109360687, 0.0360007733, 0.00759875821, 0.00102838012);
const float MIDDLE = 0.5; // subtracted from values to keep squares small
const int REACH = int(RUN) + 2 * RADIUS; // values that a run reads

void add_tap(inout vec4 sums[RUN], int k, vec4 value) {
    [[unroll]] for (int p = 0; p < RUN; p++) {
        int tap = k - p;
        if (tap >= 0 && tap <= 2 * RADIUS) sums[p] += WINDOW[tap] * value;
    }
}
