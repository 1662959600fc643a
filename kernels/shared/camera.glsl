// Cameras [2, 4, 4] f32: values, then their rounding errors.
//
// Rows 0 to 2 have the world-to-camera rotation and the world-space center; row 3 is (fx, fy, cx,
// cy) in pixels.
const uint CAMERA_ROWS = 8;

// Offset of a point from the center `center` + `rest`, exact far from the world's origin.
vec3 from_center(vec3 point, vec3 center, vec3 rest) {
    precise vec3 coarse = point - center;
    precise vec3 fine = coarse - rest;
    return fine;
}
