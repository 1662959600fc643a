//! `transforms.json` (instant-ngp, nerfstudio): camera-to-world matrices with OpenGL axes.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};

use super::super::file::{read_file, write_atomic};
use super::super::{Camera, Distortion, Image, Intrinsics, Lens, Pose};
use super::matrix::{from_opengl, rigid_matrix};
use super::{Capture, CaptureView, EQUIRECTANGULAR, joined};
use crate::{Error, Result};

const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "webp", "JPG", "PNG"];

type Parsed<T> = std::result::Result<T, String>;

pub(super) fn read(path: &Path) -> Result<Capture> {
    let bytes = read_file(path)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let parse = || {
        let shared: Value = serde_json::from_slice(&bytes).map_err(|error| error.to_string())?;
        parse(&shared, folder)
    };
    parse().map_err(|reason| Error::format(path, None, reason))
}

fn parse(shared: &Value, folder: &Path) -> Parsed<Capture> {
    let frames = shared.get("frames").and_then(Value::as_array).ok_or("frames: expected a list")?;
    let cloud = shared.get("ply_file_path").and_then(Value::as_str).unwrap_or("points.ply");
    let cloud = Some(folder.join(cloud)).filter(|path| path.is_file());
    let mut poses = Capture { points: cloud, ..Capture::default() };
    for (i, frame) in frames.iter().enumerate() {
        let fields = Fields { frame, shared, label: format!("frames[{i}]") };
        let name = fields.get("file_path").and_then(Value::as_str).ok_or_else(|| fields.lacks("file_path"))?;
        let photo = find_photo(folder, name);
        let Some((width, height)) = fields.size(photo.as_deref())? else {
            poses.sizeless.push(folder.join(name));
            continue;
        };
        let (lens, pose) = (fields.lens(width, height)?, fields.pose()?);
        let view = if lens.view_count() > 1 { fields.view()? } else { None };
        poses.frames.extend(CaptureView::of_lens(name.to_owned(), photo, lens, pose, view, &fields.label)?);
    }
    if let Some(place) = poses.sizeless.first() {
        let why = format!("no w and h, and no photo to take them from, such as {}", place.display());
        poses.warnings.push(format!("{} frames left out: {why}", poses.sizeless.len()));
    }
    Ok(poses.warn_of_cut())
}

/// Finds a photo by its name in a folder, with or without extension.
pub fn find_photo(folder: &Path, name: &str) -> Option<PathBuf> {
    let path = folder.join(name);
    let extended = EXTENSIONS.iter().map(|extension| {
        let mut extended = path.clone().into_os_string();
        extended.push(format!(".{extension}"));
        PathBuf::from(extended)
    });
    std::iter::once(path.clone()).chain(extended).find(|path| path.is_file())
}

/// A frame's fields; they default to the top level's.
struct Fields<'a> {
    frame: &'a Value,
    shared: &'a Value,
    label: String,
}

impl<'a> Fields<'a> {
    fn get(&self, key: &str) -> Option<&'a Value> {
        self.frame.get(key).or_else(|| self.shared.get(key)).filter(|value| !value.is_null())
    }

    fn lacks(&self, key: &str) -> String {
        let found = self.get(key).map_or("nothing".into(), Value::to_string);
        format!("{}.{key}: found {found}, expected a value of its type", self.label)
    }

    fn number(&self, key: &str) -> Parsed<Option<f64>> {
        self.get(key).map(|value| value.as_f64().ok_or_else(|| self.lacks(key))).transpose()
    }

    fn size(&self, photo: Option<&Path>) -> Parsed<Option<(u32, u32)>> {
        let side = |key: &str| {
            let Some(side) = self.number(key)? else { return Ok(None) };
            let whole = side.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&side);
            if whole { Ok(Some(side as u32)) } else { Err(self.lacks(key)) }
        };
        match (side("w")?, side("h")?) {
            (Some(width), Some(height)) => Ok(Some((width, height))),
            _ => photo.map(Image::size_as_stored).transpose().map_err(|error| format!("{}: {error}", self.label)),
        }
    }

    fn lens(&self, width: u32, height: u32) -> Parsed<Lens> {
        let model = self.get("camera_model").and_then(Value::as_str).unwrap_or(PINHOLE);
        if model == EQUIRECTANGULAR {
            return Lens::equirectangular(width, height, &self.label).map_err(|error| error.to_string());
        }
        Ok(Lens { distortion: self.distortion(model)?, intrinsics: self.intrinsics(width, height)?, view: 0 })
    }

    /// View of a cut photo, if the frame is one.
    fn view(&self) -> Parsed<Option<usize>> {
        let Some(view) = self.frame.get(VIEW) else { return Ok(None) };
        view.as_u64().map(|view| Some(view as usize)).ok_or_else(|| self.lacks(VIEW))
    }

    /// Except in `FULL_OPENCV`, `k4` is the coefficient of r⁸ without `k5` and `k6`, as in
    /// nerfstudio.
    fn distortion(&self, model: &str) -> Parsed<Distortion> {
        let k = |key: &str| Ok::<_, String>(self.number(key)?.unwrap_or(0.0));
        let [k1, k2, k3, k4] = [k("k1")?, k("k2")?, k("k3")?, k("k4")?];
        let fisheye = self.get("is_fisheye").and_then(Value::as_bool).unwrap_or(false);
        if fisheye || FISHEYES.contains(&model) {
            if ["k1", "k2", "k3", "k4"].iter().all(|key| self.get(key).is_none()) {
                let expected = "k1 to k4, which are 0 for an ideal lens";
                return Err(format!("{}, coefficients of a fisheye lens: found none, expected {expected}", self.label));
            }
            return Ok(Distortion::Fisheye([k1, k2, k3, k4]));
        }
        if ["FISHEYE", EQUIRECTANGULAR].iter().any(|name| model.contains(name)) {
            let expected = format!("a perspective camera, {} or {EQUIRECTANGULAR}", FISHEYES.join(", "));
            return Err(format!("{}.camera_model: found {model}, expected {expected}", self.label));
        }
        let (k5, k6, tangential) = (k("k5")?, k("k6")?, [k("p1")?, k("p2")?]);
        let is_above = model != FULL_OPENCV && k5 == 0.0 && k6 == 0.0;
        let (k4_above, k4_below) = if is_above { (k4, 0.0) } else { (0.0, k4) };
        Ok(Distortion::Perspective { numerator: [k1, k2, k3, k4_above], denominator: [k4_below, k5, k6], tangential })
    }

    fn intrinsics(&self, width: u32, height: u32) -> Parsed<Intrinsics> {
        let (w, h) = (f64::from(width), f64::from(height));
        let focal = |key: &str, angle: &str, size: f64| {
            let from_angle = self.number(angle)?.map(|angle| size / (2.0 * (angle / 2.0).tan()));
            Ok::<_, String>(self.number(key)?.or(from_angle))
        };
        let (fx, fy) = (focal("fl_x", "camera_angle_x", w)?, focal("fl_y", "camera_angle_y", h)?);
        let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
            return Err(format!("{}: found neither fl_x nor camera_angle_x", self.label));
        };
        let cx = self.number("cx")?.unwrap_or(w / 2.0);
        let cy = self.number("cy")?.unwrap_or(h / 2.0);
        Ok(Intrinsics { width, height, fx, fy, cx, cy })
    }

    fn pose(&self) -> Parsed<Pose> {
        let key = "transform_matrix";
        let matrix = self.frame.get(key).and_then(rigid_matrix);
        let matrix =
            matrix.ok_or_else(|| format!("{}.{key}: expected 4 rows of 4 numbers, the last 0 0 0 1", self.label))?;
        Ok(from_opengl(matrix))
    }
}

/// Writes cameras for nerfstudio, with shared intrinsics at the top. `names` are photo paths
/// relative to the file.
///
/// # Errors
/// [`Error::Argument`] for different numbers of cameras and names.
pub fn write_transforms(path: impl AsRef<Path>, cameras: &[Camera], names: &[impl AsRef<str>]) -> Result<()> {
    if cameras.len() != names.len() {
        return Err(Error::argument("names", names.len(), format!("one for each of {} cameras", cameras.len())));
    }
    let frame = |(camera, name): (&Camera, _)| CaptureView { name, photo: None, camera: *camera, lens: None };
    let names = names.iter().map(|name| name.as_ref().to_owned());
    write_frames(path, &cameras.iter().zip(names).map(frame).collect::<Vec<_>>(), None)
}

/// Writes posed photos as [`write_transforms`], with OpenCV distortion and the point cloud's
/// relative path.
pub fn write_frames(path: impl AsRef<Path>, frames: &[CaptureView], points: Option<&str>) -> Result<()> {
    write_frames_with(path, frames, points, &[])
}

/// As [`write_frames`], with extra fields per frame.
pub fn write_frames_with(
    path: impl AsRef<Path>,
    frames: &[CaptureView],
    points: Option<&str>,
    fields: &[Map<String, Value>],
) -> Result<()> {
    for (i, frame) in frames.iter().enumerate() {
        frame.camera.validate(&format!("camera {i}"))?;
    }
    let written = joined(frames);
    let lens = |(frame, _): &(CaptureView, Option<usize>)| {
        (frame.camera.intrinsics, frame.lens.map(|lens| Lens { view: 0, ..lens }))
    };
    let shared = written.windows(2).all(|pair| lens(&pair[0]) == lens(&pair[1]));
    let mut top = Map::from_iter([("generator".into(), json!("zipsplat"))]);
    top.extend(points.map(|points| ("ply_file_path".into(), json!(points))));
    match &written[..] {
        [(first, _), ..] if shared => top.extend(lens_fields(first)),
        [] => top.extend([("camera_model".into(), json!(PINHOLE))]),
        _ => {}
    }
    let object = |(i, (frame, view)): (usize, &(CaptureView, Option<usize>))| {
        let mut object = Map::from_iter([("file_path".into(), json!(frame.name))]);
        object.insert("transform_matrix".into(), opengl_rows(&frame.camera.pose));
        if !shared {
            object.extend(lens_fields(frame));
        }
        object.extend(view.map(|view| (VIEW.to_owned(), json!(view))));
        object.extend(fields.get(i).cloned().unwrap_or_default());
        Value::Object(object)
    };
    top.insert("frames".into(), Value::Array(written.iter().enumerate().map(object).collect()));
    write_atomic(path.as_ref(), |out| {
        serde_json::to_writer_pretty(&mut *out, &top)?;
        writeln!(out)
    })
}

const PINHOLE: &str = "PINHOLE";
const FULL_OPENCV: &str = "FULL_OPENCV";
const FISHEYES: [&str; 3] = ["OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE"];
/// Field of a frame that is one view of a photo of a wide lens.
const VIEW: &str = "view";

fn lens_fields(frame: &CaptureView) -> Map<String, Value> {
    let Some(lens) = &frame.lens else {
        let model = ("camera_model".to_owned(), json!(PINHOLE));
        return intrinsics_fields(&frame.camera.intrinsics).into_iter().chain([model]).collect();
    };
    let mut fields = Map::from_iter(intrinsics_fields(&lens.intrinsics));
    let (model, coefficients) = match lens.distortion {
        Distortion::Equirectangular => (EQUIRECTANGULAR, Vec::new()),
        Distortion::Fisheye([k1, k2, k3, k4]) => (FISHEYES[0], vec![("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4)]),
        Distortion::Perspective { numerator: [k1, k2, k3, above], denominator: [below, k5, k6], tangential } => {
            let radial = [("k1", k1), ("k2", k2), ("k3", k3), ("k4", above + below), ("k5", k5), ("k6", k6)];
            let is_full = [below, k5, k6].iter().any(|k| *k != 0.0);
            let all = radial.into_iter().chain([("p1", tangential[0]), ("p2", tangential[1])]).collect();
            (if is_full { FULL_OPENCV } else { "OPENCV" }, all)
        }
    };
    let is_written = |(name, value): &(&str, f64)| *value != 0.0 || *name == "k1" && model == FISHEYES[0];
    fields.extend(coefficients.into_iter().filter(is_written).map(|(name, value)| (name.to_owned(), json!(value))));
    fields.insert("camera_model".into(), json!(model));
    fields
}

fn intrinsics_fields(i: &Intrinsics) -> [(String, Value); 6] {
    let whole = [("w", json!(i.width)), ("h", json!(i.height))];
    let [w, h] = whole.map(|(key, value)| (key.to_string(), value));
    let real = [("fl_x", i.fx), ("fl_y", i.fy), ("cx", i.cx), ("cy", i.cy)];
    let [fx, fy, cx, cy] = real.map(|(key, value)| (key.to_string(), json!(value)));
    [w, h, fx, fy, cx, cy]
}

fn opengl_rows(pose: &Pose) -> Value {
    let (r, t) = (pose.rotation, pose.translation);
    let row = |i: usize| json!([r.x_axis[i], -r.y_axis[i], -r.z_axis[i], t[i]]);
    json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}
