// Rotation of a unit quaternion (w, x, y, z); columns are the rotated axes.
mat3 rotation(vec4 wxyz) {
    float w = wxyz.x, x = wxyz.y, y = wxyz.z, z = wxyz.w;
    return mat3(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
                2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
}
