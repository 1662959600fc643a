// Real spherical harmonics up to degree 3, with the signs of Sloan's Efficient Spherical Harmonic Evaluation (2013).

const float SH_0 = 0.2820947917738781; // of band 0, in every direction

// basis[k] for the unit direction d; what lies above `degree` is left as it is.
void spherical_harmonics(uint degree, vec3 d, inout float basis[16]) {
    basis[0] = SH_0;
    if (degree < 1) return;
    basis[1] = -0.48860251190292 * d.y;
    basis[2] = 0.48860251190292 * d.z;
    basis[3] = -0.48860251190292 * d.x;
    if (degree < 2) return;
    float zz = d.z * d.z, cos2 = d.x * d.x - d.y * d.y, sin2 = 2.0 * d.x * d.y;
    basis[4] = 0.5462742152960395 * sin2;
    basis[5] = -1.092548430592079 * d.y * d.z;
    basis[6] = 0.9461746957575601 * zz - 0.3153915652525201;
    basis[7] = -1.092548430592079 * d.x * d.z;
    basis[8] = 0.5462742152960395 * cos2;
    if (degree < 3) return;
    float ring = 0.4570457994644658 - 2.285228997322329 * zz;
    basis[9] = -0.5900435899266435 * (d.x * sin2 + d.y * cos2);
    basis[10] = 1.445305721320277 * d.z * sin2;
    basis[11] = ring * d.y;
    basis[12] = d.z * (1.865881662950577 * zz - 1.119528997770346);
    basis[13] = ring * d.x;
    basis[14] = 1.445305721320277 * d.z * cos2;
    basis[15] = -0.5900435899266435 * (d.x * cos2 - d.y * sin2);
}
