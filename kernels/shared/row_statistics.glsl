// Layer norm statistics of a row by one subgroup, for values of any offset and magnitude.
//
// The second pass avoids cancellation in the variance and corrects the mean's rounding error
// (two-pass algorithm of Chan, Golub and LeVeque 1983). The includer defines `value_of`.

float value_of(uint channel);

struct Statistics {
    float mean;
    float unit;  // of differences; keeps their squares finite
    float rest;  // rounding error of the mean, in that unit
    float scale; // 1 / standard deviation, in that unit
};

Statistics row_statistics(uint width, float eps) {
    float sum = 0.0;
    float largest = 0.0;
    for (uint c = gl_SubgroupInvocationID; c < width; c += gl_SubgroupSize) {
        float x = value_of(c);
        sum += x;
        largest = max(largest, abs(x));
    }
    float mean = subgroupAdd(sum) / float(width);
    // A power of two is exact.
    float unit = subgroupMax(largest) > 1e18 ? 5.421010862427522e-20 : 1.0;
    vec2 sums = vec2(0.0);
    for (uint c = gl_SubgroupInvocationID; c < width; c += gl_SubgroupSize) {
        float d = (value_of(c) - mean) * unit;
        sums += vec2(d, d * d);
    }
    sums = subgroupAdd(sums) / float(width);
    // Scaled squares dwarf eps; 1e-37 keeps a constant row from 0 / 0.
    float epsilon = unit < 1.0 ? 1e-37 : eps;
    return Statistics(mean, unit, sums.x, 1.0 / sqrt(max(sums.y - sums.x * sums.x, 0.0) + epsilon));
}

float normed(Statistics row, float x) { return ((x - row.mean) * row.unit - row.rest) * row.scale; }
