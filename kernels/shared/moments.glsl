// Means of a and d = a - b, the sum of the variances of a and b, and the variance of d, filtered in two steps: the variance
// of all is the mean of the variances and the variance of the means. Values are taken relative to one near them, so that
// squares are as small as the variances that are left of them.

// The values that are filtered: of means relative to `centre`, with variances.
vec4 squared(vec4 moments, vec2 centre) {
    float a = moments.x - centre.x, d = moments.y - centre.y, b = a - d;
    return vec4(a, d, moments.z + a * a + b * b, moments.w + d * d);
}

// The moments of what was filtered.
vec4 centred(vec4 filtered, vec2 centre) {
    float a = filtered.x, d = filtered.y, b = a - d;
    vec2 variances = max(filtered.zw - vec2(a * a + b * b, d * d), 0);
    return vec4(filtered.xy + centre, variances);
}
