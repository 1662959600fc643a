//! Cameras: of photos from pose files, and along paths around a scene.

use crate::options::Size;
use std::path::Path;
use zipsplat::{
    Error, Result,
    types::{
        Camera, Intrinsics, Orbit, Pose, Scene,
        poses::{Poses, read_poses},
        preprocess::{View, crop_to_aspect},
    },
};

/// The reference's figure of eight, in degrees.
const WIGGLE_AZIMUTH: f64 = 16.0;
const WIGGLE_ELEVATION: f64 = 2.0;

/// Cameras of whole photos as cameras of their views; the world becomes the first view's camera.
pub fn of_views(cameras: &[Camera], views: &[View]) -> Result<Vec<Camera>> {
    let Some(first) = cameras.first() else { return Ok(Vec::new()) };
    let of_view = |(camera, view): (&Camera, &View)| {
        let intrinsics = view.map.apply(&camera.intrinsics)?;
        Ok(Camera { intrinsics, pose: camera.pose.relative_to(&first.pose) })
    };
    cameras.iter().zip(views).map(of_view).collect()
}

/// Every camera of a pose file, where asked with the camera of the photo `origin` as the world and cropped to `size`.
/// Also what the file's reader has to say.
pub fn of_file(path: &Path, origin: Option<&Path>, size: Option<Size>) -> Result<(Vec<Camera>, Vec<String>)> {
    let poses = read_poses(path)?;
    if poses.frames.is_empty() {
        return Err(Error::argument(format!("cameras of {}", path.display()), 0, "at least one"));
    }
    let origin = origin.map(|photo| origin_pose(&poses, photo)).transpose()?;
    let camera = |camera: Camera| Camera {
        intrinsics: size.map_or(camera.intrinsics, |size| cropped(&camera.intrinsics, size)),
        pose: origin.map_or(camera.pose, |origin| camera.pose.relative_to(&origin)),
    };
    Ok((poses.frames.iter().map(|frame| camera(frame.camera)).collect(), poses.notes))
}

fn origin_pose(poses: &Poses, photo: &Path) -> Result<Pose> {
    Ok(poses.for_photos(&[photo])?[0].pose)
}

/// The middle of the picture at another size, as `reconstruct` crops photos.
fn cropped(intrinsics: &Intrinsics, Size(width, height): Size) -> Intrinsics {
    let aspect = f64::from(width) / f64::from(height.max(1));
    let rect = crop_to_aspect(intrinsics.width, intrinsics.height, aspect);
    intrinsics.crop(rect.left as i32, rect.top as i32, rect.width, rect.height).resized(width, height)
}

/// A closed path around a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraPath {
    /// Once around.
    Orbit,
    /// A figure of eight in front.
    Wiggle,
}

/// `frames` cameras along a path, with a horizontal field of view of `fov` degrees and square pixels.
pub fn along(
    path: CameraPath,
    scene: &Scene,
    frames: usize,
    Size(width, height): Size,
    fov: f64,
) -> Result<Vec<Camera>> {
    if !(fov > 0.0 && fov < 180.0) {
        return Err(Error::argument("field of view", fov, "degrees between 0 and 180"));
    }
    let orbit = Orbit::around(scene)?;
    // The last of one more is the first again.
    let mut poses = match path {
        CameraPath::Orbit => orbit.sweep(frames + 1, 0.0, 360.0, 0.0),
        CameraPath::Wiggle => orbit.wiggle(frames + 1, WIGGLE_AZIMUTH, WIGGLE_ELEVATION),
    };
    poses.truncate(frames);
    let hfov = fov.to_radians();
    let vfov = 2.0 * ((hfov / 2.0).tan() * f64::from(height) / f64::from(width)).atan();
    let intrinsics = Intrinsics::from_fov(width, height, hfov, vfov);
    Ok(poses.into_iter().map(|pose| Camera { intrinsics, pose }).collect())
}
