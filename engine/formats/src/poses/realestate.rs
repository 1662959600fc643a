//! RealEstate10K camera files (Zhou et al. 2018): a video's URL, then a frame per line.

use std::path::Path;

use glam::{DMat3, DVec3};

use super::super::file::read_file;
use super::super::{Camera, Image, Intrinsics, Pose};
use super::{Capture, CaptureView, checked, transforms::find_photo};
use crate::{Error, Result};

/// Microseconds, 4 intrinsics relative to the sides, 2 unused, and a 3 x 4 world-to-camera matrix.
const NUMBERS: usize = 19;

pub(super) fn is_file(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "txt")
        && read_file(path).is_ok_and(|bytes| bytes.starts_with(b"http"))
}

/// Frames are named by microseconds, next to the file or in a folder of its name.
pub(super) fn read(path: &Path) -> Result<Capture> {
    let bytes = read_file(path)?;
    let text = str::from_utf8(&bytes).map_err(|error| Error::format(path, None, error.to_string()))?;
    let folders = [path.with_extension(""), path.parent().unwrap_or(Path::new("")).to_owned()];
    let mut poses = Capture::default();
    for (i, line) in text.lines().enumerate().skip(1).filter(|(_, line)| !line.trim().is_empty()) {
        let label = format!("line {}", i + 1);
        let malformed = |reason: String| Error::format(path, None, format!("{label}: {reason}"));
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        if fields.len() != NUMBERS {
            return Err(malformed(format!("found {} numbers, expected {NUMBERS}", fields.len())));
        }
        let name = fields[0];
        let number = |field: &&str| {
            let value = field.parse().ok().filter(|value: &f64| value.is_finite());
            value.ok_or_else(|| malformed(format!("found {field:?}, expected a number")))
        };
        let numbers: Vec<f64> = fields.iter().map(number).collect::<Result<_>>()?;
        let Some(photo) = folders.iter().find_map(|folder| find_photo(folder, name)) else {
            poses.sizeless.push(folders[0].join(name));
            continue;
        };
        let (width, height) = Image::size_as_stored(&photo)?;
        let camera = Camera { intrinsics: intrinsics(&numbers[1..5], width, height), pose: pose(&numbers[7..]) };
        let camera = checked(camera, "camera").map_err(malformed)?;
        poses.frames.push(CaptureView { name: name.into(), photo: Some(photo), camera, lens: None });
    }
    if let Some(place) = poses.sizeless.first() {
        let count = poses.sizeless.len();
        poses.warnings.push(format!("{count} frames left out: no picture of them, such as {}", place.display()));
    }
    Ok(poses)
}

fn intrinsics(shares: &[f64], width: u32, height: u32) -> Intrinsics {
    let [w, h] = [width, height].map(f64::from);
    Intrinsics { width, height, fx: shares[0] * w, fy: shares[1] * h, cx: shares[2] * w, cy: shares[3] * h }
}

fn pose(rows: &[f64]) -> Pose {
    let column = |i: usize| DVec3::new(rows[i], rows[4 + i], rows[8 + i]);
    Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) }.inverse()
}
