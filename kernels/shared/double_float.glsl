// Double-float arithmetic, 48 bits: sums of two f32, the larger first. `precise` keeps rounding
// errors from being simplified to 0.
// Source: Dekker, A floating-point technique for extending the available precision, 1971.

vec2 carried(float high, float low) {
    precise float sum = high + low;
    precise float rest = low - (sum - high);
    return vec2(sum, rest);
}

vec2 add(float a, float b) {
    precise float sum = a + b;
    precise float shift = sum - a;
    precise float rest = (a - (sum - shift)) + (b - shift);
    return vec2(sum, rest);
}

vec2 add(vec2 a, vec2 b) {
    vec2 sum = add(a.x, b.x);
    precise float low = sum.y + (a.y + b.y);
    return carried(sum.x, low);
}

// First 12 bits of a number. The rest has 12, too, so products are exact.
float upper(float a) { return uintBitsToFloat(floatBitsToUint(a) & 0xfffff000u); }

vec2 multiply(float a, float b) {
    float a_high = upper(a), b_high = upper(b);
    precise float a_low = a - a_high, b_low = b - b_high, product = a * b;
    precise float rest = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
    return vec2(product, rest);
}

vec2 multiply(vec2 a, vec2 b) {
    vec2 product = multiply(a.x, b.x);
    precise float low = product.y + (a.x * b.y + a.y * b.x);
    return carried(product.x, low);
}

vec2 divide(vec2 a, vec2 b) {
    float quotient = a.x / b.x;
    vec2 left = add(a, -multiply(vec2(quotient, 0), b));
    return carried(quotient, left.x / b.x);
}

vec2 inner(vec2 a[3], vec2 b[3]) {
    return add(add(multiply(a[0], b[0]), multiply(a[1], b[1])), multiply(a[2], b[2]));
}
