//! Similarities between worlds, fitted to cameras or points.

use super::{Camera, PointCloud, Pose, median};
use glam::{DMat3, DQuat, DVec3, DVec4};
use nalgebra::{Matrix3, Vector3};

/// Rounds of [`Similarity::of_shared_points`].
const ROUNDS: usize = 20;

/// Maps a point x of another world to `pose(scale x)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Length here of the other world's unit.
    pub scale: f64,
    /// Rotation, then translation.
    pub pose: Pose,
}

impl From<Pose> for Similarity {
    fn from(pose: Pose) -> Self {
        Self { scale: 1.0, pose }
    }
}

impl Similarity {
    /// Returns the inverse transform.
    pub fn inverse(&self) -> Self {
        let Pose { rotation, translation } = self.pose.inverse();
        Self { scale: 1.0 / self.scale, pose: Pose { rotation, translation: translation / self.scale } }
    }

    /// Returns the similarity from pairs of a camera in another world and here, and the residual
    /// over their spread. Rotations are averaged; scale and translation are least squares. `None`
    /// for coincident or unrelated positions.
    pub fn of_cameras(pairs: &[(Camera, Camera)]) -> Option<(Self, f64)> {
        let center = |of: fn(&(Camera, Camera)) -> DVec3| pairs.iter().map(of).sum::<DVec3>() / pairs.len() as f64;
        let (from, to) = (center(|(source, _)| source.pose.translation), center(|(_, target)| target.pose.translation));
        let rotation =
            mean_turn(pairs.iter().map(|(source, target)| target.pose.rotation * source.pose.rotation.transpose()));
        let arms: Vec<[DVec3; 2]> = (pairs.iter())
            .map(|(source, target)| [rotation * (source.pose.translation - from), target.pose.translation - to])
            .collect();
        let [reach, spread] = [0, 1].map(|k| arms.iter().map(|arm| arm[k].length_squared()).sum::<f64>());
        let scale = arms.iter().map(|[source, target]| source.dot(*target)).sum::<f64>() / reach;
        let apart = arms.iter().map(|[source, target]| (scale * *source - *target).length_squared()).sum::<f64>();
        let pose = Pose { rotation, translation: to - rotation * (scale * from) };
        let usable = pairs.len() >= 2 && scale.is_finite() && scale > 0.0;
        usable.then(|| (Self { scale, pose }, (apart / spread).sqrt()))
    }

    /// Returns the least-squares similarity from points of another world to those here, with
    /// weights (Umeyama 1991). Two points leave its rotation about their line undetermined. `None`
    /// for coincident points.
    pub fn of_points(pairs: &[[DVec3; 2]], weights: &[f64]) -> Option<Self> {
        let total: f64 = weights.iter().sum();
        let mean = |k: usize| pairs.iter().zip(weights).map(|(pair, w)| *w * pair[k]).sum::<DVec3>() / total;
        let [from, to] = [mean(0), mean(1)];
        let (mut covariance, mut variance) = (Matrix3::zeros(), 0.0);
        for ([a, b], w) in pairs.iter().zip(weights) {
            let (a, b) = (*a - from, *b - to);
            covariance += *w * Vector3::from(b.to_array()) * Vector3::from(a.to_array()).transpose();
            variance += w * a.length_squared();
        }
        let svd = covariance.svd(true, true);
        let (u, v) = (svd.u?, svd.v_t?);
        let turn = if u.determinant() * v.determinant() < 0.0 { -1.0 } else { 1.0 };
        let signs = Vector3::new(1.0, 1.0, turn);
        let rotation = DMat3::from_cols_slice((u * Matrix3::from_diagonal(&signs) * v).as_slice());
        let scale = svd.singular_values.dot(&signs) / variance;
        let pose = Pose { rotation, translation: to - rotation * (scale * from) };
        (scale.is_normal() && scale > 0.0).then_some(Self { scale, pose })
    }

    /// As [`Similarity::of_points`], robust against outliers: reweights pairs by the Cauchy
    /// function of their distances over the median distance.
    pub fn of_shared_points(pairs: &[[DVec3; 2]]) -> Option<Self> {
        let mut found = Self::of_points(pairs, &vec![1.0; pairs.len()])?;
        for _ in 0..ROUNDS {
            let apart: Vec<f64> = pairs.iter().map(|[a, b]| found.point(*a).distance(*b)).collect();
            let Some(median) = median(apart.iter().copied()).filter(|median| *median > 0.0) else { break };
            let weights: Vec<f64> = apart.iter().map(|apart| 1.0 / (1.0 + (apart / median).powi(2))).collect();
            found = Self::of_points(pairs, &weights)?;
        }
        Some(found)
    }

    /// Maps a point.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.pose.transform(self.scale * point)
    }

    /// Maps the points of a cloud.
    pub fn cloud(&self, mut cloud: PointCloud) -> PointCloud {
        for at in &mut cloud.positions {
            *at = self.point(at.map(f64::from).into()).as_vec3().to_array();
        }
        cloud
    }

    /// Maps a camera.
    pub fn apply(&self, camera: &Camera) -> Camera {
        camera.placed(self.scale, &self.pose)
    }
}

/// Averages quaternions: collinear positions do not determine a rotation.
fn mean_turn(turns: impl Iterator<Item = DMat3>) -> DMat3 {
    let mut sum = DVec4::ZERO;
    for turn in turns {
        let quat = DVec4::from(DQuat::from_mat3(&turn));
        sum += if quat.dot(sum) < 0.0 { -quat } else { quat };
    }
    DMat3::from_quat(DQuat::from_vec4(sum).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Intrinsics;

    fn truth() -> Similarity {
        let pose = Pose { rotation: DMat3::from_rotation_y(2.0), translation: DVec3::new(1.0, -2.0, 3.0) };
        Similarity { scale: 2.5, pose }
    }

    fn assert_near(found: &Similarity, tolerance: f64) {
        let truth = truth();
        assert!((found.scale - truth.scale).abs() < tolerance, "{}", found.scale);
        assert!(found.pose.translation.distance(truth.pose.translation) < tolerance);
        assert!(found.pose.rotation.abs_diff_eq(truth.pose.rotation, tolerance));
    }

    #[test]
    fn points_of_another_world_are_aligned_despite_outliers() {
        let point = |k: usize| DVec3::new((k as f64 * 1.7).sin(), (k as f64 * 0.9).cos(), (k * k % 7) as f64 * 0.3);
        let mut pairs: Vec<[DVec3; 2]> = (0..60).map(|k| [point(k), truth().point(point(k))]).collect();
        assert_near(&Similarity::of_points(&pairs, &[1.0; 60]).expect("a similarity"), 1e-12);
        pairs.iter_mut().step_by(3).for_each(|pair| pair[1] += DVec3::new(4.0, 30.0, -2.0) * pair[0].x);
        let plain = Similarity::of_points(&pairs, &[1.0; 60]).expect("a similarity");
        assert!((plain.scale - truth().scale).abs() > 0.1, "{}", plain.scale);
        assert_near(&Similarity::of_shared_points(&pairs).expect("a similarity"), 1e-6);
        let scale = Similarity::of_points(&pairs[1..3], &[1.0; 2]).map(|found| found.scale);
        assert!(scale.is_some_and(|scale| (scale - 2.5).abs() < 1e-12), "{scale:?}");
        for coincident in [&[][..], &[pairs[0]; 4]] {
            assert_eq!(Similarity::of_points(coincident, &vec![1.0; coincident.len()]), None);
        }
    }

    #[test]
    fn cameras_of_another_world_are_aligned() {
        let truth = truth();
        let pair = |k: f64| {
            let pose = Pose {
                rotation: DMat3::from_rotation_x(k) * DMat3::from_rotation_z(3.0 * k),
                translation: DVec3::new(k, 0.0, 0.0),
            };
            let source = Camera { intrinsics: Intrinsics::from_fov(8, 8, 1.0, 1.0), pose };
            (source, truth.apply(&source))
        };
        let pairs = [0.0, 0.4, 1.1].map(pair);
        let (found, apart) = Similarity::of_cameras(&pairs).expect("aligned");
        assert_near(&found, 1e-12);
        assert!(apart < 1e-12, "{apart}");
        assert!(Similarity::of_cameras(&pairs[..1]).is_none(), "one camera has no length");
    }
}
