// Projects Gaussians centered far outside the image again, in double-float.
//
// In f32, rounding of rotation and center would visibly move long needles. Needs camera,
// double_float, lengths and splat.

// Slope x / z or y / z of a projection, clamped to MARGIN beyond the image.
vec2 held_slope(vec2 slope, vec2 focal, vec2 principal, float size) {
    // F32 MARGIN, its rounding error.
    vec2 beyond = multiply(vec2(MARGIN, -5.9604645e-9), vec2(size, 0));
    vec2 low = divide(-add(principal, beyond), focal);
    vec2 high = divide(add(add(vec2(size, 0), -principal), beyond), focal);
    return slope.x < low.x ? low : slope.x > high.x ? high : slope;
}

// Power of two that scales a number to 1..2.
float to_one(float largest) { return uintBitsToFloat(0x7f000000u - (floatBitsToUint(largest) & INFINITY_BITS)); }

// Rotation of a quaternion times its squared length; its largest component is 1..2.
void turn(vec4 q, out vec2 turned[3][3]) {
    vec2 ww = multiply(q.x, q.x), xx = multiply(q.y, q.y), yy = multiply(q.z, q.z), zz = multiply(q.w, q.w);
    vec2 wx = 2 * multiply(q.x, q.y), wy = 2 * multiply(q.x, q.z), wz = 2 * multiply(q.x, q.w);
    vec2 xy = 2 * multiply(q.y, q.z), xz = 2 * multiply(q.y, q.w), yz = 2 * multiply(q.z, q.w);
    turned[0] = vec2[3](add(add(ww, xx), -add(yy, zz)), add(xy, wz), add(xz, -wy));
    turned[1] = vec2[3](add(xy, -wz), add(add(ww, yy), -add(xx, zz)), add(yz, wx));
    turned[2] = vec2[3](add(xz, wy), add(yz, -wx), add(add(ww, zz), -add(xx, yy)));
}

void find_ridge(vec4 camera[CAMERA_ROWS], uvec2 size, vec3 mean, vec3 scale, vec4 quat, inout vec2 place, inout vec3 conic) {
    vec2 rows[3][3], offset[3], p[3];
    for (uint c = 0; c < 3; c++) offset[c] = add(add(mean[c], -camera[c].w), vec2(-camera[4 + c].w, 0));
    for (uint r = 0; r < 3; r++) {
        for (uint c = 0; c < 3; c++) rows[r][c] = vec2(camera[r][c], camera[4 + r][c]);
        p[r] = inner(rows[r], offset);
    }
    vec4 q = quat * to_one(largest_of(quat));
    float largest = max(max(scale.x, scale.y), scale.z);
    vec2 axes[3][3], center[2], spread[2][3];
    turn(q, axes);
    for (uint a = 0; a < 2; a++) {
        vec2 focal = vec2(camera[3][a], camera[7][a]), principal = vec2(camera[3][a + 2], camera[7][a + 2]);
        vec2 slope = divide(p[a], p[2]);
        center[a] = add(multiply(focal, slope), principal);
        slope = held_slope(slope, focal, principal, size[a]);
        vec2 row[3];
        for (uint c = 0; c < 3; c++) row[c] = add(rows[a][c], -multiply(slope, rows[2][c]));
        for (uint i = 0; i < 3; i++) spread[a][i] = multiply(inner(row, axes[i]), vec2(scale[i] * to_one(largest), 0));
    }
    // k = u v / (v v + BLUR), with u and v the rows of `spread` up to known factors.
    float pixel = p[2].x * dot(q, q) / camera[3].y * to_one(largest);
    vec2 squares = add(inner(spread[1], spread[1]), vec2(BLUR * pixel * pixel, 0));
    vec2 focals = divide(vec2(camera[3].x, camera[7].x), vec2(camera[3].y, camera[7].y));
    vec2 shear = multiply(focals, divide(inner(spread[0], spread[1]), squares));
    float row = ridge_row(center[1].x, size.y);
    vec2 rise = add(add(row, -center[1].x), vec2(-center[1].y, 0));
    place = vec2(add(center[0], multiply(shear, rise)).x, center[1].x);
    // A = yy / det, P = 1 / yy with a more exact yy: v cancels in needles along the rows.
    float better = squares.x * conic.z / pixel / pixel;
    conic = vec3(conic.x * better, shear.x, conic.z / better);
}
