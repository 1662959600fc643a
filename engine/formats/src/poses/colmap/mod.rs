//! COLMAP models, text and binary: world-to-camera poses with OpenCV axes.

mod write;

pub use write::{check_colmap_name, colmap_files, write_colmap};

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::str::SplitAsciiWhitespace;

use glam::DVec3;

use super::super::camera::{Intrinsics, Pose, matrix_from_quaternion};
use super::super::{Distortion, Lens, PointCloud, file::read_file};
use super::{Capture, CaptureView, EQUIRECTANGULAR};
use crate::fault::{Fault, Parsed};
use crate::{Error, Result};

/// Models of [`Distortion`]: ID, name, number of parameters (`f, cx, cy` or `fx, fy, cx, cy`, then
/// distortion; `w, h` of a 360-degree photo).
const MODELS: [(i32, &str, usize); 12] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (14, "SIMPLE_FISHEYE", 3),
    (15, "FISHEYE", 4),
    (17, EQUIRECTANGULAR, 2),
];
const ONE_FOCAL: [&str; 6] =
    ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE"];

/// Bytes of a 2D point in `images.bin`: x and y as f64, and the 3D point's ID.
const POINT_BYTES: u64 = 24;
/// Bytes of a track element: u32 image and 2D point IDs.
const TRACK_BYTES: u64 = 8;

pub(super) fn is_model(folder: &Path) -> bool {
    is_binary(folder) || folder.join("cameras.txt").is_file()
}

fn is_binary(folder: &Path) -> bool {
    folder.join("cameras.bin").is_file()
}

pub(super) fn read(folder: &Path) -> Result<Capture> {
    let binary = is_binary(folder);
    let [cameras, images] =
        ["cameras", "images"].map(|name| folder.join(name).with_extension(if binary { "bin" } else { "txt" }));
    let (cameras_bytes, images_bytes) = (read_file(&cameras)?, read_file(&images)?);
    let lenses = if binary { binary_cameras(&cameras_bytes) } else { text_cameras(&cameras_bytes) };
    let lenses = lenses.map_err(|fault| fault.in_file(&cameras))?;
    let views = if binary { binary_images(&images_bytes) } else { text_images(&images_bytes) };
    let mut views = views.map_err(|fault| fault.in_file(&images))?;
    // Models have hash table order.
    views.sort_by(|a, b| a.name.cmp(&b.name));

    let points = images.with_file_name("points3D").with_extension(if binary { "bin" } else { "txt" });
    let mut poses = Capture { points: Some(points).filter(|path| path.is_file()), ..Capture::default() };
    for view in views {
        let fail = |reason: String| Error::format(&images, None, reason);
        let lens = *lenses.get(&view.camera_id).ok_or_else(|| {
            fail(format!("image {:?} has camera {}, which {} lacks", view.name, view.camera_id, cameras.display()))
        })?;
        let (photo, label) = (find_photo(folder, &view.name), format!("image {:?}", view.name));
        let frames = CaptureView::of_lens(view.name, photo, lens, view.pose, None, &label);
        poses.frames.extend(frames.map_err(fail)?);
    }
    Ok(poses.warn_of_cut())
}

pub(super) fn read_points(path: &Path) -> Result<PointCloud> {
    let bytes = read_file(path)?;
    let binary = path.extension().is_some_and(|extension| extension == "bin");
    let points = if binary { binary_points(&bytes) } else { text_points(&bytes) };
    let points = points.map_err(|fault| fault.in_file(path))?;
    let (positions, colors): (Vec<[f32; 3]>, Vec<[u8; 3]>) = points.into_iter().unzip();
    match positions.iter().position(|point| !point.iter().all(|value| value.is_finite())) {
        Some(i) => {
            Err(Error::format(path, None, format!("point {i}: found {:?}, expected finite numbers", positions[i])))
        }
        None => Ok(PointCloud { positions, colors }),
    }
}

fn find_photo(model: &Path, name: &str) -> Option<PathBuf> {
    let places = model.ancestors().take(4).flat_map(|folder| [folder.join("images").join(name), folder.join(name)]);
    places.into_iter().find(|path| path.is_file())
}

type Point = ([f32; 3], [u8; 3]);

struct View {
    name: String,
    camera_id: u32,
    pose: Pose,
}

fn lens(model: &str, width: u64, height: u64, params: &[f64]) -> std::result::Result<Lens, String> {
    let side = |side: u64| u32::try_from(side).map_err(|_| format!("a side of {side} pixels"));
    let (width, height) = (side(width)?, side(height)?);
    if model == EQUIRECTANGULAR {
        return Lens::equirectangular(width, height, model).map_err(|error| error.to_string());
    }
    let (fx, fy, rest) = match *params {
        [f, ref rest @ ..] if ONE_FOCAL.contains(&model) => (f, f, rest),
        [fx, fy, ref rest @ ..] => (fx, fy, rest),
        _ => return Err(format!("{} parameters for model {model}", params.len())),
    };
    let [cx, cy, ref coefficients @ ..] = *rest else {
        return Err(format!("{} parameters for model {model}", params.len()));
    };
    let k = |i: usize| coefficients.get(i).copied().unwrap_or(0.0);
    let distortion = match model {
        _ if model.ends_with("FISHEYE") => Distortion::Fisheye([k(0), k(1), k(2), k(3)]),
        // p1 and p2 come between k2 and k3.
        _ => Distortion::Perspective {
            numerator: [k(0), k(1), k(4), 0.0],
            denominator: [k(5), k(6), k(7)],
            tangential: [k(2), k(3)],
        },
    };
    Ok(Lens { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, distortion, view: 0 })
}

/// Converts a world-to-camera quaternion wxyz and translation.
fn pose([w, x, y, z, tx, ty, tz]: [f64; 7]) -> Pose {
    Pose { rotation: matrix_from_quaternion([w, x, y, z]), translation: DVec3::new(tx, ty, tz) }.inverse()
}

fn unknown_model(model: impl std::fmt::Display) -> String {
    let known: Vec<&str> = MODELS.iter().map(|(_, name, _)| *name).collect();
    format!("camera model {model}, expected one of {}; undistort the photos in COLMAP", known.join(", "))
}

struct Line<'a> {
    number: usize,
    text: &'a str,
    fields: SplitAsciiWhitespace<'a>,
}

impl<'a> Line<'a> {
    fn fault(&self, reason: impl std::fmt::Display) -> Fault {
        format!("line {}: {reason}", self.number).into()
    }

    fn next<T: std::str::FromStr>(&mut self, field: &str) -> Parsed<T> {
        let found = self.fields.next();
        let value = found.and_then(|token| token.parse().ok());
        value.ok_or_else(|| self.fault(format!("{field}: found {:?}, expected a number", found.unwrap_or_default())))
    }
}

fn lines(bytes: &[u8]) -> Parsed<impl Iterator<Item = Line<'_>>> {
    let text = std::str::from_utf8(bytes).map_err(|error| Fault::at(error.valid_up_to(), "not UTF-8 text".into()))?;
    Ok(text.lines().enumerate().map(|(i, line)| {
        let text = line.trim();
        Line { number: i + 1, text, fields: text.split_ascii_whitespace() }
    }))
}

fn is_comment(line: &Line) -> bool {
    line.text.is_empty() || line.text.starts_with('#')
}

fn text_cameras(bytes: &[u8]) -> Parsed<HashMap<u32, Lens>> {
    let mut lenses = HashMap::new();
    for mut line in lines(bytes)?.filter(|line| !is_comment(line)) {
        let id = line.next("CAMERA_ID")?;
        let model = line.fields.next().unwrap_or_default();
        let Some((_, _, count)) = MODELS.iter().find(|(_, name, _)| *name == model) else {
            return Err(line.fault(unknown_model(model)));
        };
        let (width, height) = (line.next("WIDTH")?, line.next("HEIGHT")?);
        let params = (0..*count).map(|i| line.next(&format!("PARAMS[{i}]"))).collect::<Parsed<Vec<f64>>>()?;
        lenses.insert(id, lens(model, width, height, &params).map_err(|reason| line.fault(reason))?);
    }
    Ok(lenses)
}

fn text_images(bytes: &[u8]) -> Parsed<Vec<View>> {
    let mut views = Vec::new();
    let mut lines = lines(bytes)?;
    while let Some(mut line) = lines.next() {
        if is_comment(&line) {
            continue;
        }
        let _: u32 = line.next("IMAGE_ID")?;
        let mut numbers = [0.0; 7];
        for (number, field) in numbers.iter_mut().zip(["QW", "QX", "QY", "QZ", "TX", "TY", "TZ"]) {
            *number = line.next(field)?;
        }
        let camera_id = line.next("CAMERA_ID")?;
        let name = line.fields.collect::<Vec<_>>().join(" ");
        views.push(View { name, camera_id, pose: pose(numbers) });
        // Skips the image's 2D points, often an empty line.
        lines.next();
    }
    Ok(views)
}

fn text_points(bytes: &[u8]) -> Parsed<Vec<Point>> {
    let point = |mut line: Line| {
        let _: u64 = line.next("POINT3D_ID")?;
        let at = [line.next("X")?, line.next("Y")?, line.next("Z")?];
        Ok((at, [line.next("R")?, line.next("G")?, line.next("B")?]))
    };
    lines(bytes)?.filter(|line| !is_comment(line)).map(point).collect()
}

struct Values<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Values<'a> {
    fn fault(&self, reason: impl Into<String>) -> Fault {
        Fault::at(self.at, reason.into())
    }

    fn take<const N: usize>(&mut self, field: &str) -> Parsed<[u8; N]> {
        let bytes = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk());
        let bytes = *bytes.ok_or_else(|| self.fault(format!("truncated: {field} expected")))?;
        self.at += N;
        Ok(bytes)
    }

    fn u32(&mut self, field: &str) -> Parsed<u32> {
        self.take(field).map(u32::from_le_bytes)
    }

    fn u64(&mut self, field: &str) -> Parsed<u64> {
        self.take(field).map(u64::from_le_bytes)
    }

    fn f64(&mut self, field: &str) -> Parsed<f64> {
        self.take(field).map(f64::from_le_bytes)
    }

    fn name(&mut self) -> Parsed<String> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&byte| byte == 0).ok_or_else(|| self.fault("truncated: a name expected"))?;
        self.at += end + 1;
        Ok(String::from_utf8_lossy(&rest[..end]).into_owned())
    }

    fn skip(&mut self, count: u64, size: u64, what: &str) -> Parsed<()> {
        let left = (self.bytes.len() - self.at) as u64;
        match count.checked_mul(size).filter(|bytes| *bytes <= left) {
            Some(bytes) => self.at += bytes as usize,
            None => return Err(self.fault(format!("truncated: {count} {what} of {size} bytes, {left} bytes are left"))),
        }
        Ok(())
    }
}

// Allocates nothing by the count, which may be hostile.
fn binary_cameras(bytes: &[u8]) -> Parsed<HashMap<u32, Lens>> {
    let mut values = Values { bytes, at: 0 };
    let mut lenses = HashMap::new();
    for _ in 0..values.u64("number of cameras")? {
        let id = values.u32("camera id")?;
        let model = values.u32("model id")? as i32;
        let Some((_, name, count)) = MODELS.iter().find(|(id, _, _)| *id == model) else {
            return Err(values.fault(unknown_model(model)));
        };
        let (width, height) = (values.u64("width")?, values.u64("height")?);
        let params = (0..*count).map(|_| values.f64("parameter")).collect::<Parsed<Vec<f64>>>()?;
        lenses.insert(id, lens(name, width, height, &params).map_err(|reason| values.fault(reason))?);
    }
    Ok(lenses)
}

fn binary_images(bytes: &[u8]) -> Parsed<Vec<View>> {
    let mut values = Values { bytes, at: 0 };
    let mut views = Vec::new();
    for _ in 0..values.u64("number of images")? {
        values.u32("image id")?;
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = values.f64("pose")?;
        }
        let camera_id = values.u32("camera id")?;
        let name = values.name()?;
        views.push(View { name, camera_id, pose: pose(numbers) });
        let points = values.u64("number of points")?;
        values.skip(points, POINT_BYTES, "2D points")?;
    }
    Ok(views)
}

fn binary_points(bytes: &[u8]) -> Parsed<Vec<Point>> {
    let mut values = Values { bytes, at: 0 };
    let mut points = Vec::new();
    for _ in 0..values.u64("number of points")? {
        values.u64("point id")?;
        let at = [values.f64("x")?, values.f64("y")?, values.f64("z")?].map(|value| value as f32);
        points.push((at, values.take("color")?));
        values.f64("error")?;
        let track = values.u64("length of a track")?;
        values.skip(track, TRACK_BYTES, "elements of a track")?;
    }
    Ok(points)
}
