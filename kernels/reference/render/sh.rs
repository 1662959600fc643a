//! Spherical harmonics by associated Legendre functions.

use std::f64::consts::PI;

use glam::DVec3;

/// Computes the color of `coeffs [K, 3]` along `direction`, any length: `max(0, 0.5 + sum)`.
pub fn color(coeffs: &[f64], direction: DVec3) -> [f64; 3] {
    let degree = (coeffs.len() / 3).isqrt() as i32 - 1;
    let basis = basis(degree, direction.normalize());
    std::array::from_fn(|channel| {
        let sum: f64 = basis.iter().zip(coeffs.chunks(3)).map(|(b, c)| b * c[channel]).sum();
        (0.5 + sum).max(0.0)
    })
}

/// Computes real harmonics of unit `direction`, by band, then order, with Condon-Shortley phase.
pub fn basis(degree: i32, direction: DVec3) -> Vec<f64> {
    let azimuth = direction.y.atan2(direction.x);
    let bands = (0..=degree).flat_map(|l| (-l..=l).map(move |m| (l, m)));
    let harmonic = |(l, m): (i32, i32)| {
        let order = m.abs();
        let norm = (f64::from(2 * l + 1) / (4.0 * PI) * factorial(l - order) / factorial(l + order)).sqrt();
        let around = match m {
            0 => 1.0,
            1.. => 2f64.sqrt() * (f64::from(m) * azimuth).cos(),
            _ => 2f64.sqrt() * (f64::from(order) * azimuth).sin(),
        };
        norm * legendre(l, order, direction.z) * around
    };
    bands.map(harmonic).collect()
}

/// Associated Legendre function with factor (-1)^m, by its recurrence in l.
fn legendre(l: i32, m: i32, z: f64) -> f64 {
    let sine = (1.0 - z * z).max(0.0).sqrt();
    let diagonal = (1..=m).map(|i| -f64::from(2 * i - 1) * sine).product();
    let (mut before, mut current) = (0.0, diagonal);
    for n in m + 1..=l {
        let next = (f64::from(2 * n - 1) * z * current - f64::from(n + m - 1) * before) / f64::from(n - m);
        (before, current) = (current, next);
    }
    current
}

fn factorial(n: i32) -> f64 {
    (1..=n).map(f64::from).product()
}
