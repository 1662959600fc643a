use std::f64::consts::PI;

use glam::{DMat3, DVec3};

const COEFFS: usize = 16;

/// Returns `M` with `c' = M c`: color of `c'` in direction `R d` equals that of `c` in `d`. Entries
/// are integrals of `Y_j(d) Y_k(R⁻¹ d)`, polynomials of degree at most 6, for which quadrature with
/// four Gauss-Legendre heights and eight azimuths is exact.
pub fn sh_rotation(rotation: &DMat3) -> [[f64; COEFFS]; COEFFS] {
    let inverse = rotation.transpose();
    let spread = 2.0 / 7.0 * 1.2f64.sqrt();
    let weight = |sign: f64| (18.0 + sign * 30f64.sqrt()) / 36.0;
    let heights = [(3.0 / 7.0 - spread, weight(1.0)), (3.0 / 7.0 + spread, weight(-1.0))];
    let mut matrix = [[0.0; COEFFS]; COEFFS];
    for (square, weight) in heights {
        for (sign, i) in [1.0, -1.0].into_iter().flat_map(|sign| (0..8).map(move |i| (sign, i))) {
            let azimuth = PI / 4.0 * f64::from(i);
            let around = (1.0 - square).sqrt();
            let direction = DVec3::new(around * azimuth.cos(), around * azimuth.sin(), sign * square.sqrt());
            let (after, before) = (harmonics(direction), harmonics(inverse * direction));
            for (j, k) in (0..COEFFS).flat_map(|j| (0..COEFFS).map(move |k| (j, k))) {
                if j.isqrt() == k.isqrt() {
                    matrix[j][k] += PI / 4.0 * weight * after[j] * before[k];
                }
            }
        }
    }
    matrix
}

/// Evaluates real, orthonormal harmonics with Condon-Shortley phase, by degree, then order.
fn harmonics(d: DVec3) -> [f64; COEFFS] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let c = |numerator: f64, denominator: f64| (numerator / (denominator * PI)).sqrt();
    [
        c(1.0, 4.0),
        -c(3.0, 4.0) * y,
        c(3.0, 4.0) * z,
        -c(3.0, 4.0) * x,
        c(15.0, 4.0) * x * y,
        -c(15.0, 4.0) * y * z,
        c(5.0, 16.0) * (3.0 * zz - 1.0),
        -c(15.0, 4.0) * x * z,
        c(15.0, 16.0) * (xx - yy),
        -c(35.0, 32.0) * y * (3.0 * xx - yy),
        c(105.0, 4.0) * x * y * z,
        -c(21.0, 32.0) * y * (5.0 * zz - 1.0),
        c(7.0, 16.0) * z * (5.0 * zz - 3.0),
        -c(21.0, 32.0) * x * (5.0 * zz - 1.0),
        c(105.0, 16.0) * z * (xx - yy),
        -c(35.0, 32.0) * x * (xx - 3.0 * yy),
    ]
}
