use std::path::{Path, PathBuf};

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;
use zipsplat::types::{
    poses::{write_frames, write_transforms},
    write_atomic, write_points,
};
use zipsplat::{Error, Result};

use super::{Capture, Crop, VERSION, WideLens, WidePhoto};
use crate::{
    npy,
    outputs::{MADE_BY, is_own, remove_stale, save_json, save_picture},
};

/// Pixels between samples of the point cloud.
const POINT_STEP: usize = 8;

const SCENE: &str = "scene.json";

fn photo(number: usize) -> String {
    format!("images/{number:03}.png")
}

fn depth(number: usize) -> String {
    format!("depth/{number:03}.npy")
}

fn label(number: usize) -> String {
    format!("labels/{number:03}.png")
}

/// Returns the files to check before overwriting. A folder of ours excludes depth and labels,
/// which state no author.
pub fn files(folder: &Path, views: usize) -> Vec<PathBuf> {
    let depths = if is_own(&folder.join(SCENE)) { 0 } else { views };
    let fixed = ["transforms.json", "points.ply", SCENE].map(str::to_owned);
    (0..views)
        .map(photo)
        .chain((0..depths).flat_map(|i| [depth(i), label(i)]))
        .chain(fixed)
        .map(|name| folder.join(name))
        .collect()
}

/// Removes surplus files of an earlier scene. Depth is f32 `[height][width]`, z, 0 in the sky.
pub fn write_folder(folder: &Path, capture: &Capture, crops: &[Crop]) -> Result<()> {
    for sub in ["images", "depth", "labels"] {
        let path = folder.join(sub);
        std::fs::create_dir_all(&path).map_err(|source| Error::io(&path, source))?;
    }
    let count = capture.images.len();
    let names: Vec<String> = (0..count).map(photo).collect();
    for (i, (image, values)) in capture.images.iter().zip(&capture.depths).enumerate() {
        save_picture(&folder.join(&names[i]), image)?;
        write_atomic(&folder.join(label(i)), |out| {
            let encoder = PngEncoder::new(out);
            let written = encoder.write_image(&capture.labels[i], image.width, image.height, ExtendedColorType::L8);
            written.map_err(std::io::Error::other)
        })?;
        write_atomic(&folder.join(depth(i)), |out| out.write_all(&npy::encode(&[image.height, image.width], values)))?;
    }
    let ours = is_own(&folder.join(SCENE));
    remove_stale(&folder.join("images"), count, "png", is_own)?;
    remove_stale(&folder.join("depth"), count, "npy", |_| ours)?;
    remove_stale(&folder.join("labels"), count, "png", |_| ours)?;
    write_transforms(folder.join("transforms.json"), &capture.cameras, &names)?;
    write_points(folder.join("points.ply"), &points(capture))?;
    let scene = json!({
        "generator": MADE_BY,
        "generator_version": VERSION,
        "seed": capture.seed,
        "family": capture.family,
        "path": capture.path,
        "meters_per_unit": capture.meters,
        "overlap": capture.overlap.chunks(capture.images.len()).collect::<Vec<_>>(),
        "photo_crops": crops.iter().map(|crop| json!({"repo": crop.repo, "file": crop.file, "license": crop.license})).collect::<Vec<_>>(),
    });
    save_json(&folder.join(SCENE), &scene)
}

/// Replaces photos and points of [`write_folder`], and removes depth and labels.
pub fn write_wide(folder: &Path, capture: &Capture, lens: &WideLens, photos: &[WidePhoto]) -> Result<()> {
    let names: Vec<String> = (0..photos.len()).map(photo).collect();
    photos.iter().zip(&names).try_for_each(|((image, _), name)| save_picture(&folder.join(name), image))?;
    let points = photos.iter().flat_map(|(_, points)| points);
    let scaled = points.map(|(at, color)| ((*at / capture.meters).as_vec3().to_array(), *color));
    write_points(folder.join("points.ply"), &scaled.collect::<Vec<_>>())?;
    for (sub, extension) in [("depth", "npy"), ("labels", "png")] {
        remove_stale(&folder.join(sub), 0, extension, |_| true)?;
    }
    write_frames(folder.join("transforms.json"), &lens.frames(&capture.cameras, &names)?, Some("points.ply"))
}

fn points(capture: &Capture) -> Vec<([f32; 3], [u8; 3])> {
    let mut points = Vec::new();
    for (view, image) in capture.images.iter().enumerate() {
        for y in (0..image.height).step_by(POINT_STEP) {
            for x in (0..image.width).step_by(POINT_STEP) {
                let at = 3 * (y as usize * image.width as usize + x as usize);
                let rgb = [image.rgb[at], image.rgb[at + 1], image.rgb[at + 2]];
                points.extend(capture.point(view, x, y).map(|point| (point.as_vec3().to_array(), rgb)));
            }
        }
    }
    points
}
