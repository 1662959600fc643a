use super::{Adam, adam::HostAdam, checkpoint::State};
use crate::{
    Result,
    types::{Camera, Pose},
};
use glam::{DMat3, DQuat, DVec3};

/// Fraction of steps with fixed cameras: early scene errors would move exact cameras.
const AFTER: f64 = 0.4;

/// Adam on a camera-to-world pose.
///
/// Each step optimizes (w, v) = 0 in `pose o (exp(w^), v)`, on the camera's own axes.
#[derive(Clone, Copy, Debug, Default)]
pub struct PoseAdam(HostAdam<6>);

impl PoseAdam {
    /// Returns the pose after a step against `gradient`, d loss / d (w, v), with rates of rotation
    /// in radians and translation. A non-finite gradient changes nothing.
    pub fn step(&mut self, adam: Adam, pose: &Pose, gradient: [f64; 6], [turns, shifts]: [f64; 2]) -> Pose {
        let moved = self.0.step(adam, gradient, |i| if i < 3 { turns } else { shifts });
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::from_slice(&moved[..3])));
        pose.compose(&Pose { rotation, translation: DVec3::from_slice(&moved[3..]) })
    }
}

/// Cameras of all photos; only training cameras move.
pub(super) struct Cameras {
    cameras: Vec<Camera>,
    adams: Vec<Option<PoseAdam>>,
    /// Rates of rotation in radians and translation in scene units.
    rates: [f64; 2],
}

impl Cameras {
    pub fn new(cameras: &[Camera], moving: &[usize], rates: [f64; 2]) -> Self {
        let adam = |i| moving.contains(&i).then(PoseAdam::default);
        Self { cameras: cameras.to_vec(), adams: (0..cameras.len()).map(adam).collect(), rates }
    }

    pub fn state(&mut self, state: &mut State<'_>) -> Result<()> {
        let mut adams: Vec<_> = self.adams.iter().map(|adam| adam.map(|adam| adam.0)).collect();
        state.adams("cameras.adam", &mut adams)?;
        self.adams = adams.into_iter().map(|adam| adam.map(PoseAdam)).collect();
        poses(state, "cameras", &mut self.cameras)
    }

    pub fn all(&self) -> &[Camera] {
        &self.cameras
    }

    pub fn step(&mut self, photo: usize, gradient: [f32; 6], rate: f32, along: f64) {
        if let (Some(adam), true) = (&mut self.adams[photo], along >= AFTER) {
            let (rates, pose) = (self.rates.map(|each| each * f64::from(rate)), &mut self.cameras[photo].pose);
            *pose = adam.step(super::gaussians::ADAM, pose, gradient.map(f64::from), rates);
        }
    }
}

pub(super) fn poses(state: &mut State<'_>, name: &str, cameras: &mut [Camera]) -> Result<()> {
    let row = |camera: &Camera| -> [f64; 12] {
        let Pose { rotation, translation } = camera.pose;
        let numbers = [&rotation.to_cols_array()[..], &translation.to_array()].concat();
        std::array::from_fn(|i| numbers[i])
    };
    let mut rows: Vec<[f64; 12]> = cameras.iter().map(row).collect();
    state.fixed(name, &mut rows)?;
    for (camera, row) in cameras.iter_mut().zip(rows) {
        camera.pose = Pose { rotation: DMat3::from_cols_slice(&row[..9]), translation: DVec3::from_slice(&row[9..]) };
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_finds_its_points() {
        let points = [DVec3::new(0.3, 0.2, 2.0), DVec3::new(-0.5, 0.1, 1.5), DVec3::new(0.2, -0.6, 1.0)];
        let truth = Pose {
            rotation: DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(0.2, -0.1, 0.3))),
            translation: DVec3::new(0.1, 0.2, -0.1),
        };
        let (mut pose, mut adam) = (Pose::IDENTITY, PoseAdam::default());
        for step in 0..400 {
            let mut gradient = [0.0; 6];
            for point in points {
                // Gradient of |pose(p) - truth(p)|^2: by a shift, and by w x p for a turn.
                let by_shift = 2.0 * (pose.rotation.transpose() * (pose.transform(point) - truth.transform(point)));
                let by_turn = point.cross(by_shift);
                let both = by_turn.to_array().into_iter().chain(by_shift.to_array());
                gradient.iter_mut().zip(both).for_each(|(sum, g)| *sum += g);
            }
            let rate = 0.02 * (1.0 - f64::from(step) / 400.0);
            pose = adam.step(Adam::default(), &pose, gradient, [rate; 2]);
        }
        assert!(pose.rotation.abs_diff_eq(truth.rotation, 1e-3), "{} and {}", pose.rotation, truth.rotation);
        assert!(pose.translation.abs_diff_eq(truth.translation, 1e-3));
        let holdout = adam.step(Adam::default(), &pose, [f64::NAN; 6], [1.0; 2]);
        assert_eq!(holdout, pose);
    }
}
