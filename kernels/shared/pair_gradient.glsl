// Gradient record of a (Gaussian, camera) pair, summed over tiles.
struct PairGradient {
    vec3 first;  // moments 1, e, y of render/rasterize_backward
    vec3 second; // e e, e y, y y
    vec3 rgb;    // by color; after render/color_backward, by world offset from the camera
    float depth;
};
