//! Pixel-aligned scene at known depth.

use crate::{
    capture::{Choice, ViewSplit},
    npy,
};
use std::{f64::consts::FRAC_PI_2, path::Path};
use zipsplat::{
    Error, Result,
    depth::add_view,
    types::{Camera, Intrinsics, Scene, poses::CaptureView},
};
use zipsplat_verify::noise::Noise;

/// Correlation length of depth errors in pixels.
const SMOOTH: usize = 14;
/// Bound in standard deviations: depth stays positive.
const MOST: f64 = 3.0;

/// Returns a scene at the network's size, in the capture's world and unit. `noise` is the relative
/// deviation of depth.
pub fn scene(folder: &Path, noise: f64, choice: &Choice, capture: &ViewSplit) -> Result<Scene> {
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    let views = capture.views.cameras.iter().zip(&capture.views.images);
    for (seed, (frame, (camera, image))) in choice.input_frames().into_iter().zip(views).enumerate() {
        let mut depth = read_depth(folder, frame, camera, capture.scene_scale.length)?;
        if noise > 0.0 {
            let errors = smooth(seed as u64, image.width as usize, image.height as usize);
            depth.iter_mut().zip(errors).for_each(|(depth, error)| *depth *= (1.0 + noise * error) as f32);
        }
        add_view(&mut scene, camera, image, &depth);
    }
    if scene.is_empty() {
        return Err(Error::argument("--from-depth", "no depth above 0", "depth of what the photos show"));
    }
    Ok(scene)
}

/// Returns unit normal numbers: a grid, interpolated with weights whose squares sum to 1.
fn smooth(seed: u64, width: usize, height: usize) -> Vec<f64> {
    let mut noise = Noise::new(seed);
    let columns = width / SMOOTH + 2;
    // Twelve uniform numbers approximate a normal one.
    let mut normal = || (0..12).map(|_| f64::from(noise.uniform(-0.5, 0.5))).sum::<f64>().clamp(-MOST, MOST);
    let grid: Vec<f64> = (0..columns * (height / SMOOTH + 2)).map(|_| normal()).collect();
    let parts = |at: usize| {
        let angle = FRAC_PI_2 * (at % SMOOTH) as f64 / SMOOTH as f64;
        (at / SMOOTH, [angle.cos(), angle.sin()])
    };
    let value = |i: usize| {
        let ((x, across), (y, down)) = (parts(i % width), parts(i / width));
        let corner = |dx: usize, dy: usize| across[dx] * down[dy] * grid[(y + dy) * columns + x + dx];
        (corner(0, 0) + corner(1, 0) + corner(0, 1) + corner(1, 1)).clamp(-MOST, MOST)
    };
    (0..width * height).map(value).collect()
}

/// Nearest sampled, in the capture's unit.
fn read_depth(folder: &Path, frame: &CaptureView, camera: &Camera, unit: f64) -> Result<Vec<f32>> {
    let file = folder.join(Path::new(&frame.name).file_stem().unwrap_or_default()).with_extension("npy");
    if frame.lens.is_some() {
        let found = format!("{}, whose lens distorts", frame.name);
        return Err(Error::argument("--from-depth", found, "photos of a pinhole camera"));
    }
    let ([width, height], depth) = npy::read(&file)?;
    let of_photo = frame.camera.intrinsics;
    let stretch = f64::from(width) * f64::from(of_photo.height) / (f64::from(height) * f64::from(of_photo.width));
    if (stretch - 1.0).abs() > 0.01 {
        let expected = format!("the shape of its photo, {}x{}", of_photo.width, of_photo.height);
        return Err(Error::argument(file.display().to_string(), format!("{width}x{height}"), expected));
    }
    let (from, to) = (camera.intrinsics, of_photo.resized(width, height));
    let [columns, rows] = [0, 1].map(|axis| pixels(axis, &from, &to));
    let row = |y: &usize| {
        let row = &depth[y * width as usize..];
        columns.iter().map(|x| (f64::from(row[*x]) / unit) as f32).collect::<Vec<_>>()
    };
    Ok(rows.iter().flat_map(row).collect())
}

fn pixels(axis: usize, from: &Intrinsics, to: &Intrinsics) -> Vec<usize> {
    let lens = |i: &Intrinsics| if axis == 0 { (i.fx, i.cx, i.width) } else { (i.fy, i.cy, i.height) };
    let ((f, c, count), (to_f, to_c, most)) = (lens(from), lens(to));
    let at = |k: u32| ((f64::from(k) + 0.5 - c) / f * to_f + to_c).floor().clamp(0.0, f64::from(most - 1)) as usize;
    (0..count).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::smooth;

    #[test]
    fn errors_are_normal_and_smooth() {
        let (width, height) = (280, 140);
        let errors = smooth(7, width, height);
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let variance = errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>() / errors.len() as f64;
        assert!(mean.abs() < 0.15 && (variance - 1.0).abs() < 0.2, "{mean} {variance}");
        let steps = errors.chunks(width).flat_map(|row| row.windows(2)).map(|pair| (pair[1] - pair[0]).abs());
        assert!(steps.fold(0.0, f64::max) < 0.7);
        assert!(errors != smooth(8, width, height) && errors == smooth(7, width, height));
    }
}
