// Gradient of sum_k weights[k] basis[k] by direction; its part along d is meaningless.
vec3 spherical_harmonics_backward(uint degree, vec3 d, float weights[16]) {
    if (degree < 1) return vec3(0);
    vec3 sum = SH_1 * vec3(-weights[3], -weights[1], weights[2]);
    if (degree < 2) return sum;
    // Bands 2 and 3 share the gradients by sin2 and cos2.
    float zz = d.z * d.z, cos2 = d.x * d.x - d.y * d.y, sin2 = 2.0 * d.x * d.y;
    float d_sin2 = SH_2_2 * weights[4], d_cos2 = SH_2_2 * weights[8];
    sum += -SH_2_1 * vec3(d.z * weights[7], d.z * weights[5], d.y * weights[5] + d.x * weights[7]);
    sum.z += 2 * SH_2_0_ZZ * d.z * weights[6];
    if (degree >= 3) {
        float ring = SH_3_1 - SH_3_1_ZZ * zz;
        vec2 outer = -SH_3_3 * vec2(weights[9], weights[15]), inner = SH_3_2 * vec2(weights[10], weights[14]);
        d_sin2 += outer.x * d.x - outer.y * d.y + inner.x * d.z;
        d_cos2 += outer.x * d.y + outer.y * d.x + inner.y * d.z;
        sum.x += outer.x * sin2 + outer.y * cos2 + ring * weights[13];
        sum.y += outer.x * cos2 - outer.y * sin2 + ring * weights[11];
        sum.z += inner.x * sin2 + inner.y * cos2 + (3 * SH_3_0_ZZ * zz - SH_3_0) * weights[12];
        sum.z -= 2 * SH_3_1_ZZ * d.z * (d.y * weights[11] + d.x * weights[13]);
    }
    return sum + 2.0 * vec3(d_sin2 * d.y + d_cos2 * d.x, d_sin2 * d.x - d_cos2 * d.y, 0);
}
