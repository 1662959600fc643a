//! A scene's world, as stored in files.

use std::fmt;

use super::camera::{Pose, matrix_from_quaternion, quaternion_from_matrix};

/// Prefix of this engine's metadata: a comment in PLY and SPZ, an extra in glTF.
pub(super) const MADE_BY: &str = "zipsplat";
const PHOTO: &str = "origin: ";
const CAMERAS: &str = "world: cameras, first ";

/// World of a scene from known cameras, in their unit of length.
#[derive(Clone, Debug, PartialEq)]
pub enum World {
    /// Camera frame of the named photo: x right, y down, z forward.
    Photo(String),
    /// The cameras' world, with the pose of the first photo's camera.
    Cameras(Pose),
}

impl World {
    /// Formats a line for [`World::parse`], without the world if a photo's name has control
    /// characters.
    pub(super) fn line(world: Option<&Self>) -> String {
        match world {
            Some(world) if !matches!(world, Self::Photo(name) if name.contains(char::is_control)) => {
                format!("{MADE_BY} {world}")
            }
            _ => MADE_BY.into(),
        }
    }

    /// Parses a line of [`World::line`].
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
