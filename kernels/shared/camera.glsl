// Cameras as kernels read them.
//
// A camera is 16 numbers: three rows of the world-to-camera rotation, each with a coordinate of the camera's centre in
// the world behind it, and (fx, fy, cx, cy) in pixels. They come as f32, then again as what rounding to f32 took from each.
const uint CAMERA_ROWS = 8;

// Where a point lies from a camera's centre, the sum of `centre` and `rest`: as exact as f32 holds it, however far both
// are from the world's origin.
vec3 from_centre(vec3 point, vec3 centre, vec3 rest) {
    precise vec3 coarse = point - centre;
    precise vec3 fine = coarse - rest;
    return fine;
}
