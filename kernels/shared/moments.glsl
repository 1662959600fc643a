// Moments of a and d = a - b in two filter passes: mean a, mean d, var a + var b, var d.
//
// A total variance is the mean of variances plus the variance of means. Values are relative to a
// `center` near them, so squares do not cancel.

// Filter input, relative to `center`.
vec4 squared(vec4 moments, vec2 center) {
    float a = moments.x - center.x, d = moments.y - center.y, b = a - d;
    return vec4(a, d, moments.z + a * a + b * b, moments.w + d * d);
}

vec4 centered(vec4 filtered, vec2 center) {
    float a = filtered.x, d = filtered.y, b = a - d;
    vec2 variances = max(filtered.zw - vec2(a * a + b * b, d * d), 0);
    return vec4(filtered.xy + center, variances);
}
