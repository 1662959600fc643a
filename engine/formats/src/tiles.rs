//! Networks trained on squares handle other shapes badly and ignore principal points: each square
//! gets its own camera, turned to its center.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::{Camera, Image, Intrinsics, Pose, preprocess::PixelMap, resample::resize_lanczos};
use crate::{Error, Result};

const NEARLY_SQUARE: f64 = 1.1;
const SAMPLES: u32 = 4;

/// Returns the number of squares: longer side over shorter side, rounded up.
pub fn tile_count(width: u32, height: u32) -> usize {
    let aspect = f64::from(width.max(height)) / f64::from(width.min(height).max(1));
    if aspect < NEARLY_SQUARE { 1 } else { aspect.ceil() as usize }
}

/// Returns square views of `side` x `side` pixels covering a photo, from left or top, with cameras
/// in the world of `camera`, which may have another resolution. Squares overlap unless the ratio is
/// whole, and repeat the edge beyond it.
///
/// # Errors
/// Those of [`PixelMap::apply`] with `label`; [`Error::Argument`] if `side` is 0.
pub fn tiles(photo: &Image, camera: &Camera, side: u32, label: &str) -> Result<Vec<(Image, Camera)>> {
    photo.validate()?;
    if side == 0 {
        return Err(Error::argument("side of the squares", side, "at least 1"));
    }
    let lens = PixelMap::identity(photo).camera(camera, label)?.intrinsics;
    let fine = f64::from(side * SAMPLES) / f64::from(photo.width.min(photo.height));
    let small = |length: u32| ((f64::from(length) * fine.min(1.0)).round() as u32).max(1);
    let photo = &resize_lanczos(photo, small(photo.width), small(photo.height))?;
    let lens = lens.resized(photo.width, photo.height);
    let (edge, long) = (photo.width.min(photo.height), photo.width.max(photo.height));
    let count = tile_count(photo.width, photo.height);
    let square = |i: usize| {
        let along = match count {
            1 => f64::from(long - edge) / 2.0,
            _ => f64::from(long - edge) * i as f64 / (count - 1) as f64,
        };
        let corner = if photo.width > photo.height { [along, 0.0] } else { [0.0, along] };
        let (turn, intrinsics) = turned(&lens, corner, f64::from(edge), side);
        let pose = Pose { rotation: camera.pose.rotation * turn, ..camera.pose };
        Ok((sample(photo, &lens, &intrinsics, &turn)?, Camera { intrinsics, pose }))
    };
    (0..count).map(square).collect()
}

/// The view contains the centers of all four edges.
fn turned(lens: &Intrinsics, [left, top]: [f64; 2], edge: f64, side: u32) -> (DMat3, Intrinsics) {
    let ray = |x: f64, y: f64| DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0).normalize();
    let (x, y) = (left + edge / 2.0, top + edge / 2.0);
    let (right, bottom) = (left + edge, top + edge);
    let middle_x = ray(left, y) + ray(right, y);
    let middle_y = ray(x, top) + ray(x, bottom);
    let axis = DVec3::new(middle_x.x / middle_x.z, middle_y.y / middle_y.z, 1.0);
    let turn = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, axis.normalize()));
    let (x, y) = (lens.fx * axis.x + lens.cx, lens.fy * axis.y + lens.cy);
    let seen = |x: f64, y: f64| {
        let ray = turn.transpose() * ray(x, y);
        (ray.x / ray.z).abs().max((ray.y / ray.z).abs())
    };
    let widest = seen(left, y).max(seen(right, y)).max(seen(x, top)).max(seen(x, bottom));
    let middle = f64::from(side) / 2.0;
    let focal = middle / widest;
    (turn, Intrinsics { width: side, height: side, fx: focal, fy: focal, cx: middle, cy: middle })
}

fn sample(photo: &Image, lens: &Intrinsics, to: &Intrinsics, turn: &DMat3) -> Result<Image> {
    let offset = |sample: u32| (f64::from(sample) + 0.5) / f64::from(SAMPLES);
    let place = |u: f64, v: f64| {
        let ray = *turn * DVec3::new((u - to.cx) / to.fx, (v - to.cy) / to.fy, 1.0);
        (lens.fx * ray.x / ray.z + lens.cx, lens.fy * ray.y / ray.z + lens.cy)
    };
    let pixel = |x: u32, y: u32| {
        let mut sum = [0.0; 3];
        for (i, j) in (0..SAMPLES).flat_map(|j| (0..SAMPLES).map(move |i| (i, j))) {
            let (u, v) = place(f64::from(x) + offset(i), f64::from(y) + offset(j));
            let color = bilinear(photo, u, v);
            sum.iter_mut().zip(color).for_each(|(sum, value)| *sum += value);
        }
        sum.map(|value| (value / f64::from(SAMPLES * SAMPLES)).round() as u8)
    };
    let rows = (0..to.height).into_par_iter();
    let rgb = rows.flat_map_iter(|y| (0..to.width).flat_map(move |x| pixel(x, y))).collect();
    let mask_at = |mask: &[u8], at: u32| {
        let (x, y) = place(f64::from(at % to.width) + 0.5, f64::from(at / to.width) + 0.5);
        Image::mask_around(mask, [photo.width, photo.height], x, y)
    };
    let mask = photo.mask.as_ref().map(|mask| (0..to.width * to.height).map(|at| mask_at(mask, at)).collect());
    Ok(Image { width: to.width, height: to.height, rgb, mask })
}

fn bilinear(photo: &Image, x: f64, y: f64) -> [f64; 3] {
    let axis = |place: f64, length: u32| {
        let place = (place - 0.5).clamp(0.0, f64::from(length - 1));
        let first = place.floor();
        (first as u32, (first as u32 + 1).min(length - 1), place - first)
    };
    let ((x0, x1, right), (y0, y1, low)) = (axis(x, photo.width), axis(y, photo.height));
    let at = |x: u32, y: u32, c: usize| f64::from(photo.rgb[3 * (y as usize * photo.width as usize + x as usize) + c]);
    let row = |y: u32, c: usize| at(x0, y, c) * (1.0 - right) + at(x1, y, c) * right;
    [0, 1, 2].map(|c| row(y0, c) * (1.0 - low) + row(y1, c) * low)
}
