//! Similarity between two worlds with the same cameras.

use glam::{DMat3, DQuat, DVec3, DVec4};
use zipsplat::{
    Camera,
    types::{PointCloud, Pose},
};

/// Maps a point x of another world to `pose(scale x)`.
#[derive(Clone, Copy)]
pub struct Similarity {
    pub scale: f64,
    pub pose: Pose,
}

impl From<Pose> for Similarity {
    fn from(pose: Pose) -> Self {
        Self { scale: 1.0, pose }
    }
}

impl Similarity {
    pub fn inverse(&self) -> Self {
        let Pose { rotation, translation } = self.pose.inverse();
        Self { scale: 1.0 / self.scale, pose: Pose { rotation, translation: translation / self.scale } }
    }

    /// Returns the similarity from pairs of a camera in another world and here, and the residual
    /// over their spread. Rotations are averaged; scale and translation are least squares. `None`
    /// for coincident or unrelated positions.
    pub fn between(pairs: &[(Camera, Camera)]) -> Option<(Self, f64)> {
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

    pub fn point(&self, point: DVec3) -> DVec3 {
        self.pose.transform(self.scale * point)
    }

    pub fn cloud(&self, mut cloud: PointCloud) -> PointCloud {
        for at in &mut cloud.positions {
            *at = self.point(at.map(f64::from).into()).as_vec3().to_array();
        }
        cloud
    }

    pub fn apply(&self, camera: &Camera) -> Camera {
        camera.placed(self.scale, &self.pose)
    }
}

/// Averages quaternions: collinear positions would leave a rotation undetermined.
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
    use zipsplat::types::Intrinsics;

    #[test]
    fn cameras_of_another_world_are_aligned() {
        let truth = Similarity {
            scale: 2.5,
            pose: Pose { rotation: DMat3::from_rotation_y(2.0), translation: DVec3::new(1.0, -2.0, 3.0) },
        };
        let pair = |k: f64| {
            let pose = Pose {
                rotation: DMat3::from_rotation_x(k) * DMat3::from_rotation_z(3.0 * k),
                translation: DVec3::new(k, 0.0, 0.0),
            };
            let source = Camera { intrinsics: Intrinsics::from_fov(8, 8, 1.0, 1.0), pose };
            (source, truth.apply(&source))
        };
        let pairs = [0.0, 0.4, 1.1].map(pair);
        let (found, apart) = Similarity::between(&pairs).expect("aligned");
        assert!((found.scale - truth.scale).abs() < 1e-12 && apart < 1e-12, "{} {apart}", found.scale);
        assert!(found.pose.translation.distance(truth.pose.translation) < 1e-12);
        assert!(found.pose.rotation.abs_diff_eq(truth.pose.rotation, 1e-12));
        assert!(Similarity::between(&pairs[..1]).is_none(), "one camera has no length");
    }
}
