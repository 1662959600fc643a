// The backward kernels' record of a pair of a Gaussian and a camera, summed over its tiles.
struct PairGradient {
    vec3 first;  // moments of render/rasterise_backward: 1, e, y
    vec3 second; // e e, e y, y y
    vec3 rgb;    // the gradient of its colour; then, that of its offset from the camera's centre, world, through its colour
    float depth;
};
