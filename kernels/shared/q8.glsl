// 8-bit weights with one scale per Q8_GROUP terms of a column; their products are exact in f32.

// Lowest bits first.
vec4 q8_integers(uint word) {
    int bits = int(word);
    return vec4(bitfieldExtract(bits, 0, 8), bitfieldExtract(bits, 8, 8), bitfieldExtract(bits, 16, 8), bits >> 24);
}

vec4 q8_scales(uvec2 words) {
    return vec4(unpackHalf2x16(words.x), unpackHalf2x16(words.y));
}
