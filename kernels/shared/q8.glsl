// Weights of 8 bits: whole numbers, and for Q8_GROUP terms of a column a scale, by which f32 holds the product with each of them.

// Four integers of a word, the first in its lowest bits.
vec4 q8_integers(uint word) {
    int bits = int(word);
    return vec4(bitfieldExtract(bits, 0, 8), bitfieldExtract(bits, 8, 8), bitfieldExtract(bits, 16, 8), bits >> 24);
}

// Four scales of two words.
vec4 q8_scales(uvec2 words) {
    return vec4(unpackHalf2x16(words.x), unpackHalf2x16(words.y));
}
