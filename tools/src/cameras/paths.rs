use super::Similarity;
use crate::options::Size;
use clap::{ArgGroup, Args};
use glam::{DMat3, DVec3};
use std::{
    borrow::Cow,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{
        Camera, Dolly, Ellipse, Intrinsics, Orbit, Origin, Pose, Scene, Spline, World, mean_up,
        poses::{Capture, CaptureView},
        preprocess::crop_to_aspect,
    },
};

/// Amplitudes of the reference's figure of eight, in degrees.
const WIGGLE_AZIMUTH: f64 = 16.0;
const WIGGLE_ELEVATION: f64 = 2.0;

/// Length relative to the nearest-neighbor order, above which an order is no path.
const DETOUR: f64 = 1.5;
/// Largest error of landmarks over their distance: in one world, and after alignment.
const SAME_WORLD: f64 = 0.1;
const ALIGNED: f64 = 0.3;
/// Largest default side of a path's pictures.
const SIDE: u32 = 1280;
const FOV: f64 = 60.0;
const SIZE: Size = Size(252, 252);

#[derive(Args)]
#[command(
    group(ArgGroup::new("path").args(["cameras", "spline", "ellipse", "dolly", "orbit", "wiggle"]))
)]
pub struct CameraArgs {
    /// Cameras of a file: transforms.json, a COLMAP model's folder, nerfstudio's camera_path.json,
    /// or a JSON list of 4x4 matrices (camera-to-world, x right, y down, z forward) or of objects
    /// with matrix or viewmat and fx, fy, cx, cy, width, height
    #[arg(long, value_name = "PATH")]
    cameras: Option<PathBuf>,
    /// Smooth path through the cameras of a file
    #[arg(long, value_name = "PATH")]
    spline: Option<PathBuf>,
    /// Once around an ellipse fitted to the cameras of a file
    #[arg(long, value_name = "PATH")]
    ellipse: Option<PathBuf>,
    /// From the first view's camera straight toward the scene
    #[arg(long)]
    dolly: bool,
    /// Once around the scene, about the mean up of a file's cameras, as of --cameras, or of the
    /// scene's own photos
    #[arg(long, value_name = "PATH", num_args = 0..=1, require_equals = true)]
    orbit: Option<Option<PathBuf>>,
    /// Small figure of eight in front of the scene, the default path
    #[arg(long)]
    wiggle: bool,
    /// Return to the first camera at the end of --spline
    // Clap accepts an option that requires one of several paths with any other.
    #[arg(long = "loop", conflicts_with_all = ["cameras", "ellipse", "dolly", "orbit", "wiggle"])]
    closed: bool,
    /// Fraction of the distance to the scene's center for --dolly; negative: backward
    #[arg(long, value_name = "SHARE", default_value = "0.5", allow_negative_numbers = true,
        conflicts_with_all = ["cameras", "spline", "ellipse", "orbit", "wiggle"])]
    travel: f64,
    /// Zoom during --dolly so that the scene's center keeps its apparent size
    #[arg(long, conflicts_with_all = ["cameras", "spline", "ellipse", "orbit", "wiggle"])]
    dolly_zoom: bool,
    /// Photo whose camera is the scene's world [default: that of the scene's file, if the camera
    /// file has it, else the cameras' world]
    #[arg(long, value_name = "PHOTO", conflicts_with_all = ["dolly", "wiggle"])]
    relative_to: Option<PathBuf>,
    /// Number of pictures of a path
    #[arg(long, value_name = "N", default_value = "60", value_parser = clap::value_parser!(u32).range(1..=100_000),
        conflicts_with = "cameras")]
    frames: u32,
    /// Size of the pictures [default: that of --cameras, else of the first photo, at most 1280 a
    /// side, else 252x252]
    #[arg(long, value_name = "WxH")]
    pub size: Option<Size>,
    /// Horizontal field of view in degrees [default: that of a file's cameras, else of the first
    /// photo if known, else 60]
    #[arg(long, value_name = "DEG")]
    fov: Option<f64>,
}

impl CameraArgs {
    /// Also returns notes. `world` is the scene file's.
    pub fn cameras(&self, scene: &Scene, world: Option<&World>) -> Result<(Vec<Camera>, Vec<String>)> {
        if let (Some(None), Some(photo)) = (&self.orbit, &self.relative_to) {
            let found = format!("{} with --orbit", photo.display());
            return Err(Error::argument("--relative-to", found, "--orbit=PATH, whose cameras it places"));
        }
        let frames = self.frames as usize;
        let (mut own, up) = (world.and_then(|world| world.lens), world.and_then(|world| world.up));
        let lens = self.lens(own.as_ref())?;
        let (home, mut notes) = match (&self.orbit, world.map(|world| &world.origin)) {
            (Some(Some(file)), _) => {
                let (cameras, notes) = self.of_file(file, world, &lens, true)?;
                own = Some(cameras[0].intrinsics);
                (level(&Pose { translation: DVec3::ZERO, ..cameras[0].pose }, mean_up(&cameras)?), notes)
            }
            (_, Some(Origin::Cameras(first))) => (*first, Vec::new()),
            _ => (Pose::IDENTITY, Vec::new()),
        };
        let home = match (up, &self.orbit) {
            (Some(up), Some(None)) => level(&home, up),
            (_, None) => {
                // The first photo may be stored on its side.
                let turns = world.map_or(0, |world| world.turns);
                let upright = Camera { intrinsics: own.unwrap_or(lens), pose: home }.turned(turns);
                own = own.map(|_| upright.intrinsics);
                upright.pose
            }
            _ => home,
        };
        let lens = self.lens(own.as_ref())?;
        let with_lens = |poses: Vec<Pose>| poses.into_iter().map(|pose| Camera { intrinsics: lens, pose }).collect();
        let path = if self.orbit.is_some() {
            let orbit = Orbit::around(&seen_from(scene, &home))?;
            with_lens(orbit.sweep(frames + 1, 0.0, 360.0, 0.0)[..frames].to_vec())
        } else if self.dolly {
            let camera = Camera { intrinsics: lens, pose: Pose::IDENTITY };
            let distance = Orbit::around(&seen_from(scene, &home))?.center.z;
            let dolly = Dolly { camera, distance, travel: self.travel, zoom: self.dolly_zoom };
            dolly.validate()?;
            dolly.sample(frames)
        } else if let Some(file) = &self.spline {
            let (cameras, found) = self.of_file(file, world, &lens, true)?;
            let (cameras, note) = by_nearness(cameras);
            notes = found;
            notes.extend(note);
            return Ok((Spline::through(&cameras, self.closed)?.sample(frames), notes));
        } else if let Some(file) = &self.ellipse {
            let (cameras, notes) = self.of_file(file, world, &lens, true)?;
            let poses = Ellipse::around(&cameras, Orbit::around(scene)?.center)?.sample(frames);
            let intrinsics = cameras[0].intrinsics;
            return Ok((poses.into_iter().map(|pose| Camera { intrinsics, pose }).collect(), notes));
        } else if let Some(file) = &self.cameras {
            return self.of_file(file, world, &lens, false);
        } else {
            let orbit = Orbit::around(&seen_from(scene, &home))?;
            with_lens(orbit.wiggle(frames + 1, WIGGLE_AZIMUTH, WIGGLE_ELEVATION)[..frames].to_vec())
        };
        let placed = |camera: Camera| Camera { pose: home.compose(&camera.pose), ..camera };
        Ok((path.into_iter().map(placed).collect(), notes))
    }

    pub fn doubt(&self) -> &'static str {
        let file = matches!(self.orbit, Some(Some(_)))
            || self.cameras.is_some()
            || self.spline.is_some()
            || self.ellipse.is_some();
        match (file, &self.relative_to) {
            (true, None) => {
                ": the scene's world may be the camera of the first photo that it was made from, while the cameras have one \
                 of their own; --relative-to PHOTO, with that photo, brings them together"
            }
            (true, Some(_)) => ": --relative-to may name another photo than the first that the scene was made from",
            (false, _) => "",
        }
    }

    fn lens(&self, own: Option<&Intrinsics>) -> Result<Intrinsics> {
        let size = self.size.or(own.map(shown)).unwrap_or(SIZE);
        match (own, self.fov) {
            (Some(own), None) => Ok(cropped(own, size)),
            (_, fov) => with_fov(size, fov.unwrap_or(FOV)),
        }
    }

    /// Reads a file's cameras, in the world of the requested photo, else of the scene's photo if
    /// present. Crops them to a requested size. `along` a path, cameras are upright, of the first
    /// one's size.
    fn of_file(
        &self,
        path: &Path,
        world: Option<&World>,
        lens: &Intrinsics,
        along: bool,
    ) -> Result<(Vec<Camera>, Vec<String>)> {
        let mut poses = Capture::open_cameras(path, lens)?;
        let seen = |frame: &CaptureView| if along { frame.upright_camera() } else { frame.camera };
        let Some(first) = poses.frames.first() else {
            let found = poses.warnings.first().map_or("none".into(), |why| format!("none: {why}"));
            return Err(Error::argument(format!("cameras of {}", path.display()), found, "at least one"));
        };
        let size = self.size.or(along.then(|| shown(&seen(first).intrinsics)));
        let (to_scene, note) = to_scene(self.relative_to.as_deref(), &poses, world, path)?;
        let camera = |camera: Camera| {
            let own = camera.intrinsics;
            let intrinsics = match (self.fov, size) {
                (Some(fov), _) => with_fov(size.unwrap_or(Size(own.width, own.height)), fov)?,
                (None, Some(size)) => cropped(&own, size),
                (None, None) => own,
            };
            Ok(Camera { intrinsics, ..to_scene.apply(&camera) })
        };
        let cameras = poses.frames.iter().map(|frame| camera(seen(frame))).collect::<Result<_>>()?;
        poses.warnings.extend(note);
        Ok((cameras, poses.warnings))
    }
}

#[derive(Args)]
pub struct WorldPhoto {
    /// Photo whose camera is the scene's world [default: that of the scene's file, else the
    /// cameras' world]
    #[arg(long, value_name = "PHOTO", requires = "cameras")]
    pub relative_to: Option<PathBuf>,
}

/// Maps a file's cameras to the scene's world, with a note.
pub fn to_scene(
    relative_to: Option<&Path>,
    poses: &Capture,
    world: Option<&World>,
    path: &Path,
) -> Result<(Similarity, Option<String>)> {
    if let Some(photo) = relative_to {
        return Ok((origin_pose(poses, photo)?.inverse().into(), None));
    }
    let file = path.display();
    let (given, note) = match world.map(|world| &world.origin) {
        Some(Origin::Cameras(_)) => (Pose::IDENTITY, None),
        Some(Origin::Photo(photo)) => match origin_pose(poses, Path::new(photo)) {
            Ok(pose) => (pose.inverse(), None),
            Err(_) => {
                let note = format!(
                    "the scene's world is the camera of {photo}, which {file} has not: its cameras are taken as if they \
                     counted from that photo; `reconstruct --world input-cameras` makes scenes in the world of the cameras"
                );
                (Pose::IDENTITY, Some(note))
            }
        },
        None => {
            let note = format!(
                "the scene's file does not say which world it is in: the cameras of {file} are taken to be in the same; \
                 --relative-to PHOTO where it is the camera of that photo"
            );
            (Pose::IDENTITY, Some(note))
        }
    };
    let Some(aligned) = world.and_then(|world| aligned(&given, poses, world)) else { return Ok((given.into(), note)) };
    match aligned {
        Ok((aligned, names)) => {
            let note =
                format!("the cameras of {file} are in another world than the scene: aligned by those of {names}");
            Ok((aligned, Some(note)))
        }
        Err(names) => {
            let found = format!("{names}, apart from each other in another direction than in the scene's world");
            let expected = "the cameras of the scene's photos; --relative-to PHOTO for others with their names";
            Err(Error::argument(format!("cameras of {file}"), found, expected))
        }
    }
}

/// Returns `None` if the landmarks agree after `given` or are absent; otherwise the similarity by
/// pose and distance, or an error. Both name the photos.
fn aligned(given: &Pose, poses: &Capture, world: &World) -> Option<Result<(Similarity, String), String>> {
    let [(first, from), (last, to)] = &world.landmarks[..] else { return None };
    let [a, b] = [first, last].map(|name| origin_pose(poses, Path::new(name)).ok());
    let (a, b) = (a?, b?);
    let (length, found) = (from.distance(*to), a.translation.distance(b.translation));
    let off = |to_scene: &Similarity| {
        [(a, from), (b, to)].map(|(pose, at)| to_scene.point(pose.translation).distance(*at)).into_iter().sum::<f64>()
    };
    if off(&(*given).into()) <= SAME_WORLD * length {
        return None;
    }
    let names = format!("{first} and {last}");
    let home = match &world.origin {
        Origin::Photo(_) => Pose::IDENTITY,
        Origin::Cameras(first) => *first,
    };
    let (scale, back) = (length / found, a.inverse());
    let onto = Similarity { scale, pose: home.compose(&Pose { translation: scale * back.translation, ..back }) };
    Some(if off(&onto) <= ALIGNED * length { Ok((onto, names)) } else { Err(names) })
}

fn seen_from<'a>(scene: &'a Scene, home: &Pose) -> Cow<'a, Scene> {
    if *home == Pose::IDENTITY {
        return Cow::Borrowed(scene);
    }
    let mut scene = scene.clone();
    scene.place(1.0, &home.inverse());
    Cow::Owned(scene)
}

/// Levels a pose, keeping its heading.
fn level(pose: &Pose, up: DVec3) -> Pose {
    let forward = pose.rotation.z_axis.reject_from_normalized(up);
    let forward = forward.try_normalize().unwrap_or_else(|| up.any_orthonormal_vector());
    Pose { rotation: DMat3::from_cols(forward.cross(up), -up, forward), ..*pose }
}

fn by_nearness(cameras: Vec<Camera>) -> (Vec<Camera>, Option<String>) {
    let length = |cameras: &[Camera]| -> f64 { cameras.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum() };
    let (mut chain, mut left) = (vec![cameras[0]], cameras[1..].to_vec());
    while let Some(next) = (0..left.len()).min_by(|a, b| {
        let last = &chain[chain.len() - 1];
        distance(last, &left[*a]).total_cmp(&distance(last, &left[*b]))
    }) {
        chain.push(left.remove(next));
    }
    let (given, near) = (length(&cameras), length(&chain));
    if given <= DETOUR * near {
        return (cameras, None);
    }
    let note = format!(
        "--spline visits cameras by nearness: in their own order its path is {:.1} times as long",
        given / near
    );
    (chain, Some(note))
}

fn distance(a: &Camera, b: &Camera) -> f64 {
    a.pose.translation.distance(b.pose.translation)
}

fn origin_pose(poses: &Capture, photo: &Path) -> Result<Pose> {
    Ok(poses.for_photos(&[photo])?[0].pose)
}

fn shown(intrinsics: &Intrinsics) -> Size {
    let (width, height) = (intrinsics.width, intrinsics.height);
    let scale = f64::from(SIDE) / f64::from(width.max(height));
    let side = |side: u32| if scale < 1.0 { ((f64::from(side) * scale).round() as u32).max(1) } else { side };
    Size(side(width), side(height))
}

fn with_fov(Size(width, height): Size, fov: f64) -> Result<Intrinsics> {
    if !(fov > 0.0 && fov < 180.0) {
        return Err(Error::argument("field of view", fov, "degrees between 0 and 180"));
    }
    let horizontal = fov.to_radians();
    let vertical = 2.0 * ((horizontal / 2.0).tan() * f64::from(height) / f64::from(width)).atan();
    Ok(Intrinsics::from_fov(width, height, horizontal, vertical))
}

/// Crops as `reconstruct` crops photos.
fn cropped(intrinsics: &Intrinsics, Size(width, height): Size) -> Intrinsics {
    let aspect = f64::from(width) / f64::from(height.max(1));
    let rect = crop_to_aspect(intrinsics.width, intrinsics.height, aspect);
    intrinsics.crop(rect.left as i32, rect.top as i32, rect.width, rect.height).resized(width, height)
}
