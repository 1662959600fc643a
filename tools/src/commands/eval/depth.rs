use crate::{
    capture::{Choice, ViewSplit},
    npy,
};
use std::path::Path;
use zipsplat::{
    Error, Result,
    depth::add_view,
    types::{Camera, Intrinsics, Scene, poses::CaptureView},
};

/// Returns a scene at the network's size, in the capture's world and unit.
pub fn scene(folder: &Path, choice: &Choice, capture: &ViewSplit) -> Result<Scene> {
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    let views = capture.views.cameras.iter().zip(&capture.views.images);
    for (frame, (camera, image)) in choice.input_frames().into_iter().zip(views) {
        let depth = read_depth(folder, frame, camera, capture.scene_scale.length)?;
        add_view(&mut scene, camera, image, &depth);
    }
    if scene.is_empty() {
        return Err(Error::argument("--from-depth", "no depth above 0", "depth of what the photos show"));
    }
    Ok(scene)
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
