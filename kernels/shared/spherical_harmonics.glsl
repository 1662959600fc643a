// Real spherical harmonics up to degree 3, with the signs of Sloan, Efficient Spherical Harmonic
// Evaluation, 2013.

// Polynomial factors by band and order; ZZ multiplies z^2.
const float SH_0 = 0.2820947917738781;
const float SH_1 = 0.48860251190292;
const float SH_2_2 = 0.5462742152960395, SH_2_1 = 1.092548430592079;
const float SH_2_0_ZZ = 0.9461746957575601, SH_2_0 = 0.3153915652525201;
const float SH_3_3 = 0.5900435899266435, SH_3_2 = 1.445305721320277;
const float SH_3_1 = 0.4570457994644658, SH_3_1_ZZ = 2.285228997322329;
const float SH_3_0_ZZ = 1.865881662950577, SH_3_0 = 1.119528997770346;

// Basis for unit direction d; leaves entries above `degree` unchanged.
void spherical_harmonics(uint degree, vec3 d, inout float basis[16]) {
    basis[0] = SH_0;
    if (degree < 1) return;
    basis[1] = -SH_1 * d.y;
    basis[2] = SH_1 * d.z;
    basis[3] = -SH_1 * d.x;
    if (degree < 2) return;
    float zz = d.z * d.z, cos2 = d.x * d.x - d.y * d.y, sin2 = 2.0 * d.x * d.y;
    basis[4] = SH_2_2 * sin2;
    basis[5] = -SH_2_1 * d.y * d.z;
    basis[6] = SH_2_0_ZZ * zz - SH_2_0;
    basis[7] = -SH_2_1 * d.x * d.z;
    basis[8] = SH_2_2 * cos2;
    if (degree < 3) return;
    float ring = SH_3_1 - SH_3_1_ZZ * zz;
    basis[9] = -SH_3_3 * (d.x * sin2 + d.y * cos2);
    basis[10] = SH_3_2 * d.z * sin2;
    basis[11] = ring * d.y;
    basis[12] = d.z * (SH_3_0_ZZ * zz - SH_3_0);
    basis[13] = ring * d.x;
    basis[14] = SH_3_2 * d.z * cos2;
    basis[15] = -SH_3_3 * (d.x * cos2 - d.y * sin2);
}
