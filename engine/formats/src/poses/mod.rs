//! Camera files: `transforms.json` (instant-ngp, nerfstudio), COLMAP, RealEstate10K, camera paths,
//! matrices.

mod camera_path;
mod colmap;
mod matrix;
mod realestate;
mod scene_scale;
mod transforms;

use std::collections::{HashMap, HashSet};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::ptr;

use serde_json::Value;

use super::camera::{Camera, Intrinsics, Pose, matrix_from_quaternion, quaternion_from_matrix};
use super::{CUT_VIEW_DEG, Image, Lens, LensView, MAX_VIEW_DEG, Masks, PointCloud, file::read_file};
use crate::{Error, Result};

pub use colmap::{check_colmap_name, colmap_files, write_colmap};
pub use scene_scale::{SceneScale, Source};
pub use transforms::{find_photo, write_frames, write_frames_with, write_transforms};

/// Photos with cameras. Photos of lenses wider than [`MAX_VIEW_DEG`] have a frame for each of their
/// [`Lens::views`], adjacent and of one name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Capture {
    /// In file order, or by name if the file has none.
    pub frames: Vec<CaptureView>,
    /// Path for [`read_cloud`], if present: `ply_file_path`, `points.ply` or COLMAP's `points3D`.
    pub points: Option<PathBuf>,
    /// Ignored data, for the user.
    pub warnings: Vec<String>,
    /// Expected photos of frames left out because their size is unknown.
    pub sizeless: Vec<PathBuf>,
}

/// A posed photo.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureView {
    /// Name in the file.
    pub name: String,
    /// Path, if found near the file.
    pub photo: Option<PathBuf>,
    /// Pinhole camera in the file's world and unit; the shown view of a `lens`.
    pub camera: Camera,
    /// Lens, if it distorts.
    pub lens: Option<Lens>,
}

impl CaptureView {
    /// Returns a frame for each view of the lens, or for one.
    fn of_lens(
        name: String,
        photo: Option<PathBuf>,
        lens: Lens,
        pose: Pose,
        view: Option<usize>,
        label: &str,
    ) -> Result<Vec<Self>, String> {
        let camera = checked(Camera { intrinsics: lens.intrinsics, pose }, label)?;
        if lens.distortion.is_none() {
            return Ok(vec![Self { name, photo, camera, lens: None }]);
        }
        let views = lens.views(label).map_err(|error| error.to_string())?;
        if let Some(view) = view.filter(|view| *view >= views.len()) {
            return Err(format!("{label}.view: found {view}, expected a number below {}", views.len()));
        }
        let frame = |(i, LensView { intrinsics, rotation }): (usize, &LensView)| {
            let turned = Pose { rotation: camera.pose.rotation * *rotation, ..camera.pose };
            let pose = if i == 0 { camera.pose } else { turned };
            let (name, photo, lens) = (name.clone(), photo.clone(), Some(Lens { view: i, ..lens }));
            Self { name, photo, camera: Camera { intrinsics: *intrinsics, pose }, lens }
        };
        Ok(views.iter().enumerate().filter(|(i, _)| view.is_none_or(|view| view == *i)).map(frame).collect())
    }

    /// Returns the photo's [`Image::quarter_turns`]; 0 without a photo, for mirrored ones, and if
    /// the camera has the upright photo's sides, as some programs write it.
    pub fn quarter_turns(&self) -> u32 {
        let Some(photo) = &self.photo else { return 0 };
        let own = self.lens.map_or(self.camera.intrinsics, |lens| lens.intrinsics);
        let swaps = |(width, height): (u32, u32)| width != height && width.cmp(&height) == own.height.cmp(&own.width);
        let turns = Image::quarter_turns(photo).unwrap_or(0);
        if turns % 2 == 1 && Image::size_as_stored(photo).is_ok_and(swaps) { 0 } else { turns }
    }

    /// Returns the camera of the upright photo.
    pub fn upright_camera(&self) -> Camera {
        self.camera.turned(self.quarter_turns())
    }

    /// Returns whether this is a later view of a photo.
    pub fn is_later_view(&self) -> bool {
        self.lens.is_some_and(|lens| lens.view > 0)
    }

    /// Returns the size of the frame's picture of a photo.
    pub fn size(&self, photo: [u32; 2]) -> [u32; 2] {
        self.lens.map_or(photo, |lens| lens.view_size(photo))
    }

    fn photo_pose(&self) -> Pose {
        match self.lens.filter(|lens| lens.view > 0) {
            Some(lens) => {
                let rotation = self.camera.pose.rotation * lens.rotation().transpose();
                Pose { rotation, ..self.camera.pose }
            }
            None => self.camera.pose,
        }
    }

    /// Opens a photo as this frame's camera sees it: undistorted, without EXIF orientation.
    pub fn open(&self, path: impl AsRef<Path>) -> Result<Image> {
        self.undistort(Image::open_as_stored(path)?)
    }

    /// Opens a photo as [`CaptureView::open`], with its mask.
    pub fn open_masked(&self, path: impl AsRef<Path>, masks: &Masks) -> Result<Image> {
        self.undistort(masks.open(path, true)?)
    }

    fn undistort(&self, photo: Image) -> Result<Image> {
        match &self.lens {
            Some(lens) => lens.undistort(&photo),
            None => Ok(photo),
        }
    }
}

impl Capture {
    /// Reads camera poses of a capture.
    ///
    /// Accepts a `transforms.json`, a COLMAP model folder (`cameras` and `images` as `.bin` or
    /// `.txt`), or a folder with one of these, directly or under `sparse/0`. Without
    /// `transforms.json`, a folder's `transforms_train.json` is read. A text file that starts with
    /// a URL is RealEstate10K, with frames next to it or in a folder of its name.
    ///
    /// # Errors
    /// [`Error::Format`] with file, frame and field, [`Error::Argument`] if `path` has no known
    /// cameras.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let found = path.metadata().map_err(|source| Error::io(path, source))?;
        if found.is_file() && path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) {
            return transforms::read(path);
        }
        if found.is_file() && realestate::is_file(path) {
            return realestate::read(path);
        }
        let folder = if found.is_file() { path.parent().unwrap_or(path) } else { path };
        if found.is_dir()
            && let Some(file) = TRANSFORMS.map(|name| path.join(name)).into_iter().find(|file| file.is_file())
        {
            return transforms::read(&file);
        }
        let model = ["", "0", "sparse/0", "sparse", "colmap/sparse/0"].iter().map(|below| folder.join(below));
        match model.into_iter().find(|model| colmap::is_model(model)) {
            Some(model) => colmap::read(&model),
            None => Err(Error::argument("poses", path.display(), "a transforms.json or a COLMAP model's folder")),
        }
    }

    /// Reads cameras for rendering.
    ///
    /// Accepts the files of [`Capture::open`], nerfstudio's `camera_path.json`, and JSON lists of
    /// camera-to-world matrices with OpenCV axes (4 x 4 or flat), or of objects with `matrix` (the
    /// same) or `viewmat` (world-to-camera). Objects may have their own lens: `fx`, `width`,
    /// `height`, and optionally `fy`, `cx`, `cy`. The default is `lens`.
    pub fn open_cameras(path: impl AsRef<Path>, lens: &Intrinsics) -> Result<Self> {
        let path = path.as_ref();
        if path.is_file() && path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) {
            let bytes = read_file(path)?;
            let value: Value =
                serde_json::from_slice(&bytes).map_err(|error| Error::format(path, None, error.to_string()))?;
            let parsed = match &value {
                Value::Array(list) => Some(matrix::parse_list(list, lens)),
                _ if value.get("camera_path").is_some() => Some(camera_path::parse(&value)),
                _ => None,
            };
            if let Some(parsed) = parsed {
                return parsed.map_err(|reason| Error::format(path, None, reason));
            }
        }
        Self::open(path)
    }

    /// Determines the scene scale for `views` by [`SceneScale::of`].
    pub fn scene_scale(&self, given: Option<f64>, views: &[Camera], origin: &Pose) -> Result<SceneScale> {
        let cameras: Vec<Pose> = self.frames.iter().map(|frame| frame.camera.pose).collect();
        SceneScale::of(given, &cameras, self.points.as_deref(), views, origin)
    }

    /// Returns the cameras of [`Capture::frames_of`].
    pub fn for_photos(&self, photos: &[impl AsRef<Path>]) -> Result<Vec<Camera>> {
        Ok(self.frames_of(photos)?.into_iter().map(|frame| frame.camera).collect())
    }

    /// Returns the frames of `photos`, matched by file name, then by the longest common end of the
    /// path. A repeated photo has its views in order, as of [`Capture::per_view`].
    ///
    /// # Errors
    /// [`Error::Argument`] for a photo without a frame, with several equal matches, or with another
    /// photo's frame.
    pub fn frames_of(&self, photos: &[impl AsRef<Path>]) -> Result<Vec<&CaptureView>> {
        let find = |photo: &Path| self.frame_of(photo)?.ok_or_else(|| self.lacks(photo));
        let frames = photos.iter().map(|photo| find(photo.as_ref())).collect::<Result<Vec<&CaptureView>>>()?;
        // A photo may be given twice, but two cannot share a frame.
        let file = |photo: &Path| photo.canonicalize().unwrap_or_else(|_| photo.to_path_buf());
        let mut photo_of: HashMap<*const CaptureView, (&Path, usize)> = HashMap::new();
        let mut views = Vec::new();
        for (photo, frame) in photos.iter().map(AsRef::as_ref).zip(frames) {
            let (other, count) = photo_of.entry(frame).or_insert((photo, 0));
            if *other != photo && file(other) != file(photo) {
                let found = format!("{}, as of {}", frame.name, other.display());
                return Err(Error::argument(format!("camera of {}", photo.display()), found, "one of its own"));
            }
            let of_photo = self.views_of(frame);
            views.push(&of_photo[*count % of_photo.len()]);
            *count += 1;
        }
        Ok(views)
    }

    /// Sets the photos of all views of the frames of `photos`, matched as in
    /// [`Capture::frames_of`].
    ///
    /// # Errors
    /// Those of [`Capture::frames_of`].
    pub fn attach(&mut self, photos: &[impl AsRef<Path>]) -> Result<()> {
        let mut photo_of: HashMap<*const CaptureView, PathBuf> = HashMap::new();
        for (frame, photo) in self.frames_of(photos)?.into_iter().zip(photos) {
            photo_of
                .extend(self.views_of(frame).iter().map(|view| (ptr::from_ref(view), photo.as_ref().to_path_buf())));
        }
        for frame in &mut self.frames {
            if let Some(photo) = photo_of.remove(&ptr::from_ref(frame)) {
                frame.photo = Some(photo);
            }
        }
        Ok(())
    }

    /// Returns the frames of the photo whose first is given.
    pub fn views_of<'a>(&'a self, first: &'a CaptureView) -> &'a [CaptureView] {
        let Some(start) = self.frames.iter().position(|frame| ptr::eq(frame, first)) else {
            return std::slice::from_ref(first);
        };
        let later = self.frames[start + 1..].iter();
        let count = later.take_while(|frame| frame.is_later_view() && frame.name == first.name).count();
        &self.frames[start..=start + count]
    }

    /// Returns the photos, each once per view.
    pub fn per_view(&self, photos: Vec<PathBuf>) -> Result<Vec<PathBuf>> {
        let mut views = Vec::new();
        for photo in photos {
            let count = self.frame_of(&photo)?.map_or(1, |first| self.views_of(first).len());
            views.extend(std::iter::repeat_n(photo, count));
        }
        Ok(views)
    }

    fn warn_of_cut(mut self) -> Self {
        let cut: HashSet<&str> =
            self.frames.iter().filter(|frame| frame.is_later_view()).map(|frame| frame.name.as_str()).collect();
        let views = self.frames.iter().filter(|frame| cut.contains(frame.name.as_str())).count();
        if !cut.is_empty() {
            self.warnings.push(format!(
                "photos of lenses wider than {MAX_VIEW_DEG} degrees, {} of them, are cut into {views} pinhole views of \
                 {CUT_VIEW_DEG} degrees",
                cut.len(),
            ));
        }
        self
    }

    fn lacks(&self, photo: &Path) -> Error {
        let what = format!("camera of {}", photo.display());
        let is_same = |place: &&PathBuf| [photo.file_name(), photo.file_stem()].contains(&place.file_name());
        match self.sizeless.iter().find(is_same) {
            Some(place) => {
                let found = format!("no w and h beside it, and no photo to take them from at {}", place.display());
                Error::argument(what, found, "w and h in the cameras' file, or the photo where that file says it is")
            }
            None => Error::argument(what, "none", self.names()),
        }
    }

    /// Returns the frame of a photo, matched as in [`Capture::frames_of`], if any.
    ///
    /// # Errors
    /// [`Error::Argument`] for several equal matches.
    pub fn frame_of(&self, photo: impl AsRef<Path>) -> Result<Option<&CaptureView>> {
        let photo = photo.as_ref();
        let named = |name: Option<&OsStr>| -> Vec<&CaptureView> {
            self.frames.iter().filter(|frame| Path::new(&frame.name).file_name() == name).collect()
        };
        let mut found = named(photo.file_name());
        if found.is_empty() {
            found = named(photo.file_stem());
        }
        found.dedup_by(|later, first| later.is_later_view() && later.name == first.name);
        let common = |frame: &CaptureView| common_folders(photo, Path::new(&frame.name));
        let most = found.iter().map(|frame| common(frame)).max();
        match found.iter().filter(|frame| Some(common(frame)) == most).collect::<Vec<_>>()[..] {
            [] => Ok(None),
            [frame] => Ok(Some(frame)),
            [first, second, ..] => {
                let found = format!("{}, as like {} as {}", photo.display(), first.name, second.name);
                Err(Error::argument("photo", found, "a path that tells the poses' frames apart"))
            }
        }
    }

    fn names(&self) -> String {
        let names: Vec<&str> = self.frames.iter().take(3).map(|frame| frame.name.as_str()).collect();
        let more = if self.frames.len() > names.len() { ", ..." } else { "" };
        format!("its file name among those of the poses ({}): {}{more}", self.frames.len(), names.join(", "))
    }
}

/// Returns the frames to write: views of a photo as one frame if their poses agree, else each with
/// its number.
fn joined(frames: &[CaptureView]) -> Vec<(CaptureView, Option<usize>)> {
    let mut written = Vec::new();
    let mut rest = frames;
    while let Some(first) = rest.first() {
        let count = first.lens.map_or(1, |lens| lens.view_count());
        let pose = first.photo_pose();
        let is_next = |(i, frame): (usize, &CaptureView)| {
            let agrees = frame.photo_pose().matrix().abs_diff_eq(pose.matrix(), SAME_POSE);
            frame.name == first.name && frame.lens == first.lens.map(|lens| Lens { view: i, ..lens }) && agrees
        };
        let are_joined = rest.len() >= count && rest[..count].iter().enumerate().all(is_next);
        let photo = CaptureView { camera: Camera { pose, ..first.camera }, ..first.clone() };
        written.push((photo, first.lens.map(|lens| lens.view).filter(|_| !are_joined && count > 1)));
        rest = &rest[if are_joined { count } else { 1 }..];
    }
    written
}

/// Camera model of 360-degree photos, in transforms.json and COLMAP.
const EQUIRECTANGULAR: &str = "EQUIRECTANGULAR";

/// Largest difference of the matrices of one photo's views.
const SAME_POSE: f64 = 1e-9;

fn common_folders(a: &Path, b: &Path) -> usize {
    let above = |path: &Path| path.parent().map(Path::to_path_buf).unwrap_or_default();
    let (a, b) = (above(a), above(b));
    a.components().rev().zip(b.components().rev()).take_while(|(a, b)| a == b).count()
}

/// NeRF's synthetic scenes have their training views in transforms_train.json.
const TRANSFORMS: [&str; 2] = ["transforms.json", "transforms_train.json"];

/// Reads a PLY, `points3D.bin` or `points3D.txt`.
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud> {
    let path = path.as_ref();
    let is_colmap = ["points3D.bin", "points3D.txt"].iter().any(|name| path.ends_with(name));
    if is_colmap { colmap::read_points(path) } else { super::read_points(path) }
}

fn checked(mut camera: Camera, label: &str) -> Result<Camera, String> {
    camera.validate(label).map_err(|error| error.to_string())?;
    camera.pose.rotation = matrix_from_quaternion(quaternion_from_matrix(&camera.pose.rotation));
    Ok(camera)
}
