// What a subgroup norms a row by (layer norm), however far its values lie from 0 and from each other.
//
// The variance takes a second pass, as a difference of sums would cancel; that pass also finds what rounding left in the mean
// (corrected two-pass algorithm: Chan, Golub and LeVeque 1983), which is more than the spread where the mean is far above it.
// The includer gives `float value_of(uint channel)`, the values of the row.

float value_of(uint channel);

struct Statistics {
    float mean;
    float unit;  // of differences from it: squares of values beyond 1.8e19 would overflow
    float rest;  // what rounding left in the mean, in that unit
    float scale; // one over the standard deviation, in that unit
};

Statistics row_statistics(uint width, float eps) {
    float sum = 0.0;
    float largest = 0.0;
    for (uint c = gl_LocalInvocationID.x; c < width; c += gl_WorkGroupSize.x) {
        float x = value_of(c);
        sum += x;
        largest = max(largest, abs(x));
    }
    float mean = subgroupAdd(sum) / float(width);
    // A power of two, which rounds nothing.
    float unit = subgroupMax(largest) > 1e18 ? 5.421010862427522e-20 : 1.0;
    vec2 sums = vec2(0.0); // of differences and of their squares
    for (uint c = gl_LocalInvocationID.x; c < width; c += gl_WorkGroupSize.x) {
        float d = (value_of(c) - mean) * unit;
        sums += vec2(d, d * d);
    }
    sums = subgroupAdd(sums) / float(width);
    // Epsilon is nothing beside the squares of a row that has such a unit, but keeps a constant one from 0 / 0.
    float epsilon = unit < 1.0 ? 1e-37 : eps;
    return Statistics(mean, unit, sums.x, 1.0 / sqrt(max(sums.y - sums.x * sums.x, 0.0) + epsilon));
}

float normed(Statistics row, float x) { return ((x - row.mean) * row.unit - row.rest) * row.scale; }
