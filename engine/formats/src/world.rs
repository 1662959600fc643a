use std::fmt;

use glam::DVec3;

use super::camera::{Camera, Intrinsics, Pose, matrix_from_quaternion, quaternion_from_matrix};
use super::poses::CaptureView;
use super::trajectory::mean_up;

/// Prefix of metadata: a comment in PLY and SPZ, the generator in SOG, an extra in glTF.
pub(super) const MADE_BY: &str = "zipsplat";
const PHOTO: &str = "origin: ";
const CAMERAS: &str = "world: cameras, first ";
const CAMERA: &str = "camera ";
const LENS: &str = "lens ";
const UP: &str = "up ";
const TURNS: &str = "turns ";
/// Names of photos with control characters are not stored.
const SEPARATOR: char = '\t';

/// World of a scene from known cameras, in their unit of length.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    /// The coordinate frame.
    pub origin: Origin,
    /// Names and camera centers of the first photo and the farthest one, to recognize the world.
    pub landmarks: Vec<(String, DVec3)>,
    /// Size and field of view of the first photo.
    pub lens: Option<Intrinsics>,
    /// The cameras' mean up, if they agree on one.
    pub up: Option<DVec3>,
    /// Clockwise quarter turns that make the first photo's picture upright.
    pub turns: u32,
}

/// Coordinate frame of a scene.
#[derive(Clone, Debug, PartialEq)]
pub enum Origin {
    /// Camera frame of the named photo.
    Photo(String),
    /// The cameras' world, with the pose of the first photo's camera.
    Cameras(Pose),
}

impl World {
    /// Returns the first photo's camera frame, if any.
    pub fn of_first(frames: &[&CaptureView]) -> Option<Self> {
        let first = frames.first()?;
        Some(Self::of(Origin::Photo(first.name.clone()), &first.camera.pose.inverse(), frames))
    }

    /// Returns the cameras' world, if any.
    pub fn of_cameras(frames: &[&CaptureView]) -> Option<Self> {
        Some(Self::of(Origin::Cameras(frames.first()?.camera.pose), &Pose::IDENTITY, frames))
    }

    fn of(origin: Origin, to_world: &Pose, frames: &[&CaptureView]) -> Self {
        let center = |frame: &&CaptureView| to_world.transform(frame.camera.pose.translation);
        let from_first = |frame: &&&CaptureView| center(frame).distance(center(&frames[0]));
        let farthest = frames.iter().skip(1).max_by(|a, b| from_first(a).total_cmp(&from_first(b)));
        let landmarks = frames.first().into_iter().chain(farthest.filter(|frame| from_first(frame) > 0.0));
        let landmarks = landmarks.map(|frame| (frame.name.clone(), center(frame))).collect();
        let upright: Vec<Camera> = frames.iter().map(|frame| frame.upright_camera()).collect();
        let up = mean_up(&upright).ok().map(|up| to_world.rotation * up);
        let first = frames.first();
        let (lens, turns) = (first.map(|frame| frame.camera.intrinsics), first.map(|frame| frame.quarter_turns()));
        Self { origin, landmarks, lens, up, turns: turns.unwrap_or(0) }
    }

    pub(super) fn line(world: Option<&Self>) -> String {
        let is_named = |world: &&Self| !matches!(&world.origin, Origin::Photo(name) if name.contains(char::is_control));
        let Some(world) = world.filter(is_named) else { return MADE_BY.into() };
        let landmarks = world.landmarks.iter().filter(|(name, _)| !name.contains(char::is_control));
        let landmarks: String =
            landmarks.map(|(name, at)| format!("{SEPARATOR}{CAMERA}{} {} {} {name}", at.x, at.y, at.z)).collect();
        let lens = world.lens.map(|lens| {
            let Intrinsics { fx, fy, cx, cy, width, height } = lens;
            format!("{SEPARATOR}{LENS}{width} {height} {fx} {fy} {cx} {cy}")
        });
        let up = world.up.map(|up| format!("{SEPARATOR}{UP}{} {} {}", up.x, up.y, up.z));
        let turns = (world.turns > 0).then(|| format!("{SEPARATOR}{TURNS}{}", world.turns));
        let further = [lens, up, turns].into_iter().flatten().collect::<String>();
        format!("{MADE_BY} {}{landmarks}{further}", world.origin)
    }

    pub(super) fn parse(line: &str) -> Option<Self> {
        let mut parts = line.strip_prefix(MADE_BY)?.strip_prefix(' ')?.split(SEPARATOR);
        let origin = Origin::parse(parts.next()?)?;
        let landmark = |text: &str| {
            let mut words = text.strip_prefix(CAMERA)?.splitn(4, ' ');
            let mut number = || words.next()?.parse().ok();
            let center = DVec3::new(number()?, number()?, number()?);
            Some((words.next()?.to_owned(), center)).filter(|(_, center)| center.is_finite())
        };
        let lens = |text: &str| {
            let [width, height, fx, fy, cx, cy] = numbers(text.strip_prefix(LENS)?)?;
            let lens = Intrinsics { fx, fy, cx, cy, width: width as u32, height: height as u32 };
            Camera { intrinsics: lens, pose: Pose::IDENTITY }.validate("lens").is_ok().then_some(lens)
        };
        let up = |text: &str| DVec3::from_array(numbers(text.strip_prefix(UP)?)?).try_normalize();
        let turns = |text: &str| text.strip_prefix(TURNS)?.parse().ok().filter(|turns| *turns < 4);
        let (lens, up) = (parts.clone().find_map(lens), parts.clone().find_map(up));
        let turns = parts.clone().find_map(turns).unwrap_or(0);
        Some(Self { origin, landmarks: parts.filter_map(landmark).collect(), lens, up, turns })
    }
}

impl From<Origin> for World {
    fn from(origin: Origin) -> Self {
        Self { origin, landmarks: Vec::new(), lens: None, up: None, turns: 0 }
    }
}

impl Origin {
    fn parse(text: &str) -> Option<Self> {
        if let Some(photo) = text.strip_prefix(PHOTO) {
            return Some(Self::Photo(photo.into()));
        }
        let [w, x, y, z, tx, ty, tz] = numbers(text.strip_prefix(CAMERAS)?)?;
        let quat: [f64; 4] = [w, x, y, z];
        let length = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
        let pose = Pose { rotation: matrix_from_quaternion(quat), translation: [tx, ty, tz].into() };
        (length.is_normal() && pose.rotation.is_finite() && pose.translation.is_finite()).then_some(Self::Cameras(pose))
    }
}

/// Parses numbers separated by spaces.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Option<Vec<f64>> = text.split(' ').map(|number| number.parse().ok()).collect();
    numbers?.try_into().ok()
}

impl fmt::Display for Origin {
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
