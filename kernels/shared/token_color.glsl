// PCG hash, a byte per channel (Jarzynski and Olano, Hash Functions for GPU Rendering, 2020).
vec3 token_color(uint token) {
    uint state = token * 747796405u + 2891336453u;
    uint word = (state >> (state >> 28) + 4 ^ state) * 277803737u;
    uint hash = word >> 22 ^ word;
    return vec3(uvec3(hash, hash >> 8, hash >> 16) & 255) / 255;
}
