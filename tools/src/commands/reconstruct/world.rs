use super::forward::Forward;
use clap::ValueEnum;
use zipsplat::types::{Pose, World, poses::CaptureView};

/// Visible step of positions, over the scene's distance.
const COARSE: f64 = 1e-3;

#[derive(Clone, Copy, ValueEnum)]
pub enum WorldName {
    /// The first photo's camera: x right, y down, z forward
    #[value(alias = "first")]
    FirstCamera,
    /// The world of the cameras, for other programs
    #[value(alias = "cameras")]
    InputCameras,
}

impl WorldName {
    pub fn of(self, frames: &[&CaptureView]) -> Option<World> {
        match self {
            Self::FirstCamera => World::of_first(frames),
            Self::InputCameras => World::of_cameras(frames),
        }
    }
}

/// `forward` has the length of the network's unit.
pub fn coarse(first: &Pose, forward: Option<&Forward>) -> Option<String> {
    // Positions are f32.
    let (step, length) = (first.translation.length() * f64::from(f32::EPSILON), forward?.length);
    (step > COARSE * length).then(|| {
        let world = "the world of the cameras begins far from them";
        format!("{world}: positions there have steps of {step:.2e}, of a scene {length:.2e} away")
    })
}
