use glam::DVec3;
use nalgebra::{Matrix3, Vector3};

/// Least-squares scale of a similarity (Umeyama 1991), `None` for coincident points.
pub fn scale_between(from: &[DVec3], to: &[DVec3]) -> Option<f64> {
    let mean = |points: &[DVec3]| points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let (from_mean, to_mean) = (mean(from), mean(to));
    let (mut covariance, mut variance) = (Matrix3::zeros(), 0.0);
    for (a, b) in from.iter().zip(to) {
        let (a, b) = (*a - from_mean, *b - to_mean);
        covariance += Vector3::from(b.to_array()) * Vector3::from(a.to_array()).transpose();
        variance += a.length_squared();
    }
    let svd = covariance.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let turn = if (u.determinant() * v.determinant()) < 0.0 { -1.0 } else { 1.0 };
    let scale = (svd.singular_values[0] + svd.singular_values[1] + turn * svd.singular_values[2]) / variance;
    (scale.is_normal() && scale > 0.0).then_some(scale)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn a_similarity_is_undone() {
        let from = [DVec3::new(1.0, 0.0, 0.5), DVec3::new(-0.3, 2.0, 0.1), DVec3::new(0.2, 0.4, -1.0)];
        let turn = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 2.0);
        let to = from.map(|point| 0.3 * (turn * point) + DVec3::new(5.0, -2.0, 1.0));
        for count in [2, 3] {
            let scale = scale_between(&from[..count], &to[..count]).expect("the points differ");
            assert!((scale - 0.3).abs() < 1e-12, "{scale}");
        }
        assert_eq!(scale_between(&[from[0]; 3], &to), None);
        assert_eq!(scale_between(&[], &[]), None);
    }
}
