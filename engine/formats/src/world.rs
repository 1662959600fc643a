//! The world that a scene is in, as files say it.

use std::fmt;

use super::camera::{Pose, matrix_from_quaternion, quaternion_from_matrix};

/// Begins what this engine writes into files about themselves: a comment of a PLY or an SPZ, an extra of a glTF.
pub(super) const MADE_BY: &str = "zipsplat";
const PHOTO: &str = "origin: ";
const CAMERAS: &str = "world: cameras, first ";

/// The world that a scene made with known cameras is in. Its unit of length is the cameras'.
#[derive(Clone, Debug, PartialEq)]
pub enum World {
    /// The camera of the photo of this name: x right, y down, z forward.
    Photo(String),
    /// The cameras' own world, in which the first photo's camera has this pose.
    Cameras(Pose),
}

impl World {
    /// A line that says it, for [`World::parse`]; none where a photo's name cannot be part of a line.
    pub(super) fn line(world: Option<&Self>) -> String {
        match world {
            Some(world) if !matches!(world, Self::Photo(name) if name.contains(char::is_control)) => {
                format!("{MADE_BY} {world}")
            }
            _ => MADE_BY.into(),
        }
    }

    /// What a line of [`World::line`] says.
    pub(super) fn parse(line: &str) -> Option<Self> {
        let said = line.strip_prefix(MADE_BY)?.strip_prefix(' ')?;
        if let Some(photo) = said.strip_prefix(PHOTO) {
            return Some(Self::Photo(photo.into()));
        }
        let numbers = said.strip_prefix(CAMERAS)?.split(' ').map(str::parse);
        let numbers: Vec<f64> = numbers.collect::<std::result::Result<_, _>>().ok()?;
        let [w, x, y, z, tx, ty, tz] = numbers.try_into().ok()?;
        let quat: [f64; 4] = [w, x, y, z];
        let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
        let pose = Pose { rotation: matrix_from_quaternion(quat), translation: [tx, ty, tz].into() };
        (length.is_normal() && pose.rotation.is_finite() && pose.translation.is_finite()).then_some(Self::Cameras(pose))
    }
}

impl fmt::Display for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Photo(name) => write!(f, "{PHOTO}{name}"),
            Self::Cameras(pose) => {
                let ([w, x, y, z], t) = (quaternion_from_matrix(&pose.rotation), pose.translation);
                write!(f, "{CAMERAS}{w} {x} {y} {z} {} {} {}", t.x, t.y, t.z)
            }
        }
    }
}
