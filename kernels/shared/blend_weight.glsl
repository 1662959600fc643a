// Returns the blending weight of an alpha by the rules of render/rasterize. The transmittance
// turns negative once the pixel is done. Needs splat.
float blend_weight(inout float transmittance, float alpha) {
    bool seen = alpha >= ALPHA_MIN && transmittance > 0;
    float left = transmittance * (1 - alpha);
    bool drawn = seen && left > TRANSMITTANCE_MIN;
    float weight = drawn ? alpha * transmittance : 0;
    transmittance = drawn ? left : seen ? -transmittance : transmittance;
    return weight;
}
