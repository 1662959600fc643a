use glam::DVec3;
use serde::Serialize;
use std::path::{Path, PathBuf};
use zipsplat::{
    Result,
    types::{
        Camera, Intrinsics, Pose, World,
        poses::{Capture, CaptureView},
        resample::resize_lanczos,
    },
};

/// Default lens: 60 degrees.
const SIDE: u32 = 512;
const FOV: f64 = 60.0;

pub const QUALITY: u8 = 90;
pub const SMALL_QUALITY: u8 = 75;

/// Of the upright photo. Lengths in pixels, camera-to-world, x right, y down, z forward.
#[derive(Serialize)]
pub struct InputCamera {
    name: String,
    matrix: [[f64; 4]; 3],
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    photo: Option<String>,
    #[serde(skip)]
    frame: CaptureView,
    /// Clockwise quarter turns that show the photo upright.
    #[serde(skip)]
    turns: u32,
}

impl InputCamera {
    pub fn new(frame: CaptureView, pose: &Pose, file: Option<PathBuf>) -> Self {
        let mut frame = CaptureView { photo: file.clone().or(frame.photo), ..frame };
        let turns = frame.quarter_turns();
        frame.photo = file;
        let Camera { intrinsics, pose } = Camera { pose: *pose, ..frame.camera }.turned(turns);
        let Intrinsics { width, height, fx, fy, cx, cy } = intrinsics;
        let (r, t) = (pose.rotation, pose.translation);
        let matrix = [0, 1, 2].map(|i| [r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]]);
        Self { name: frame.name.clone(), matrix, width, height, fx, fy, cx, cy, photo: None, frame, turns }
    }

    pub fn has_photo(&self) -> bool {
        self.frame.photo.is_some()
    }

    pub fn at(&mut self, address: String) {
        self.photo = Some(address);
    }

    /// Undistorted, at most `side` pixels long; `None` without a photo.
    pub fn jpeg(&self, side: Option<u32>) -> Result<Option<Vec<u8>>> {
        let Some(file) = &self.frame.photo else { return Ok(None) };
        let photo = self.frame.open(file)?.turned(self.turns);
        let longest = photo.width.max(photo.height);
        match side.filter(|side| *side < longest) {
            Some(side) => {
                let [width, height] = [photo.width, photo.height].map(|own| (own * side / longest).max(1));
                resize_lanczos(&photo, width, height)?.jpeg(SMALL_QUALITY)
            }
            None => photo.jpeg(QUALITY),
        }
        .map(Some)
    }
}

/// Reads cameras into the scene's world, with notes.
pub fn input_cameras(
    file: &Path,
    relative_to: Option<&Path>,
    world: Option<&World>,
    photo_of: impl Fn(&CaptureView) -> Option<PathBuf>,
) -> Result<(Vec<InputCamera>, Vec<String>)> {
    let fov = FOV.to_radians();
    let mut poses = Capture::open_cameras(file, &Intrinsics::from_fov(SIDE, SIDE, fov, fov))?;
    let (to_scene, note) = crate::cameras::to_scene(relative_to, &poses, world, file)?;
    poses.warnings.extend(note);
    let camera = |frame: CaptureView| {
        let pose = to_scene.apply(&frame.camera).pose;
        let photo = photo_of(&frame);
        InputCamera::new(frame, &pose, photo)
    };
    Ok((poses.frames.into_iter().map(camera).collect(), poses.warnings))
}

pub fn vertical(cameras: &[InputCamera]) -> Option<[f64; 3]> {
    let up = cameras.iter().map(|camera| -DVec3::from(camera.matrix.map(|row| row[1]))).sum::<DVec3>();
    up.try_normalize().map(DVec3::into)
}
