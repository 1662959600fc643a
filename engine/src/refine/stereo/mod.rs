//! Points by plane-sweep stereo where structure from motion found none.

mod pairs;
mod sweep;

use super::{
    Photos,
    length::{PIXELS_PER_GAUSSIAN, sizes},
    photos::PhotoCache,
    views::View,
};
use crate::{
    Error, Result,
    types::{Camera, PointCloud},
};
use glam::DVec3;
use pairs::{Pairing, pairings};
use rayon::prelude::*;
use std::ops::ControlFlow;
use sweep::{Depths, sweep};

const MAX_SIDE: u32 = 160;
/// More are thinned evenly.
const MAX_PHOTOS: usize = 64;
/// Least correlation of a point, and of pixels that confirm it.
const CORRELATED: f32 = 0.6;
const CONFIRMING: f32 = 0.42;
/// Fewest photos that confirm a point, and the relative difference of their depths.
const AGREEING: usize = 2;
const TOLERANCE: f64 = 0.01;
/// Relative difference of depths of a surface, and its fewest pixels in a window of nine.
const SMOOTHNESS: f64 = 0.04;
const SMOOTH: usize = 6;
/// Side of a point's cell: in pixels of the photo, and its least when matched.
const CELL: f64 = 4.0;
const MIN_CELL: f64 = 2.0;

struct Photo {
    view: View,
    gray: Vec<f32>,
    pairing: Pairing,
    cell_side: usize,
}

/// Appends points to those of structure from motion, where three photos or more agree on a depth,
/// up to `most` in all, by default one per 32 pixels. Cameras are of the whole photos, in the
/// points' world; `progress` gets the completed fraction.
///
/// # Errors
/// [`Error::Argument`] for an unusable photo or camera, [`Error::Cancelled`] from `progress`.
pub fn stereo_points(
    photos: &dyn Photos,
    cameras: &[Camera],
    cloud: &PointCloud,
    most: Option<usize>,
    mut progress: impl FnMut(f64) -> ControlFlow<()>,
) -> Result<PointCloud> {
    let given = cloud.positions.len();
    let by_default = || {
        let pixels: f64 = sizes(photos, None, 1).map(|[width, height]| f64::from(width) * f64::from(height)).sum();
        (pixels / PIXELS_PER_GAUSSIAN) as usize
    };
    let most_added = most.unwrap_or_else(by_default).saturating_sub(given);
    if photos.count() != cameras.len() {
        let expected = format!("one for each of {} photos", photos.count());
        return Err(Error::argument("cameras", cameras.len(), expected));
    }
    if most_added == 0 {
        return Ok(cloud.clone());
    }
    let photos = opened(photos, cameras, cloud)?;
    let mut depths = Vec::with_capacity(photos.len());
    for some in photos.chunks(rayon::current_num_threads()) {
        if progress(depths.len() as f64 / photos.len() as f64).is_break() {
            return Err(Error::Cancelled);
        }
        depths.par_extend(some.par_iter().map(|photo| sweep(photo, &photos)));
    }
    let confirmed: Vec<_> =
        photos.par_iter().zip(&depths).map(|(photo, of)| confirmed(photo, of, &photos, &depths)).collect();
    let mut joined = cloud.clone();
    joined.colors.resize(given, PointCloud::GRAY);
    let mut taken: Vec<Vec<bool>> = photos.iter().map(|photo| vec![false; photo.gray.len()]).collect();
    take(&mut taken, &photos, &depths, &cloud.positions);
    for (i, photo) in photos.iter().enumerate() {
        let first = joined.positions.len();
        for pixel in chosen(photo, &depths[i], &confirmed[i], &taken[i]) {
            joined.positions.push(photo.point(pixel, depths[i].depths[pixel]).as_vec3().to_array());
            joined.colors.push(photo.view.image.rgb.as_chunks().0[pixel]);
        }
        take(&mut taken, &photos, &depths, &joined.positions[first..]);
    }
    let added = joined.positions.len() - given;
    if added > most_added {
        for i in 0..most_added {
            let from = given + i * added / most_added;
            joined.positions[given + i] = joined.positions[from];
            joined.colors[given + i] = joined.colors[from];
        }
        joined.positions.truncate(given + most_added);
        joined.colors.truncate(given + most_added);
    }
    Ok(joined)
}

fn opened(photos: &dyn Photos, cameras: &[Camera], cloud: &PointCloud) -> Result<Vec<Photo>> {
    let count = photos.count();
    let chosen: Vec<usize> = (0..count).step_by(count.div_ceil(MAX_PHOTOS).max(1)).collect();
    let views = PhotoCache::new(photos, Some([MAX_SIDE; 2]), false, 0, None).views(cameras, &chosen, &[], 1)?;
    let seen: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let photo = |(view, pairing): (View, Pairing)| {
        let luma = |rgb: &[u8; 3]| {
            let [r, g, b] = rgb.map(f32::from);
            0.299 * r + 0.587 * g + 0.114 * b
        };
        let gray = view.image.rgb.as_chunks().0.iter().map(luma).collect();
        let scale = f64::from(view.size[0]) / f64::from(photos.size(view.photo)[0]);
        Photo { gray, pairing, cell_side: (CELL * scale).round().max(MIN_CELL) as usize, view }
    };
    Ok(views.into_iter().zip(pairings(&seen, cloud)).map(photo).collect())
}

impl Photo {
    fn size(&self) -> [usize; 2] {
        self.view.size.map(|side| side as usize)
    }

    fn cell(&self, pixel: usize) -> usize {
        let [width, _] = self.size();
        let [x, y] = [pixel % width, pixel / width].map(|at| at - at % self.cell_side);
        y * width + x
    }

    fn point(&self, pixel: usize, depth: f32) -> DVec3 {
        let ([width, _], i) = (self.size(), &self.view.camera.intrinsics);
        let [x, y] = [pixel % width, pixel / width].map(|at| at as f64 + 0.5);
        let ray = DVec3::new((x - i.cx) / i.fx, (y - i.cy) / i.fy, 1.0);
        self.view.camera.pose.transform(f64::from(depth) * ray)
    }

    /// Pixel and depth of a point, if the camera sees it.
    fn project(&self, point: DVec3) -> Option<(usize, f64)> {
        let DVec3 { x, y, z } = self.view.camera.project(point)?;
        Some((y as usize * self.size()[0] + x as usize, z))
    }
}

fn confirmed(photo: &Photo, of: &Depths, photos: &[Photo], depths: &[Depths]) -> Vec<bool> {
    let ([width, height], mask) = (photo.size(), photo.view.image.mask.as_ref());
    let agree = |pixel: usize| {
        if of.scores[pixel] < CORRELATED || mask.is_some_and(|mask| mask[pixel] == 0) {
            return false;
        }
        let point = photo.point(pixel, of.depths[pixel]);
        let agrees = |source: &&usize| {
            let Some((at, depth)) = photos[**source].project(point) else { return false };
            let (found, score) = (f64::from(depths[**source].depths[at]), depths[**source].scores[at]);
            score > CONFIRMING && (found - depth).abs() < TOLERANCE * depth
        };
        photo.pairing.sources.iter().filter(agrees).count() >= AGREEING
    };
    let agree: Vec<bool> = (0..width * height).map(agree).collect();
    let smooth = |pixel: usize| {
        let around = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
        let rows = around(pixel / width, height);
        let near = rows.flat_map(|y| around(pixel % width, width).map(move |x| y * width + x));
        let depth = |pixel: usize| f64::from(of.depths[pixel]);
        let is_close = |at: &usize| (depth(*at) - depth(pixel)).abs() < SMOOTHNESS * depth(pixel);
        near.filter(|at| agree[*at] && is_close(at)).count() >= SMOOTH
    };
    (0..width * height).map(|pixel| agree[pixel] && smooth(pixel)).collect()
}

/// The most correlated pixel of each free cell.
fn chosen(photo: &Photo, of: &Depths, confirmed: &[bool], taken: &[bool]) -> Vec<usize> {
    let mut best: Vec<Option<usize>> = vec![None; taken.len()];
    for pixel in (0..taken.len()).filter(|pixel| confirmed[*pixel]) {
        let cell = photo.cell(pixel);
        if !taken[cell] && best[cell].is_none_or(|best| of.scores[pixel] > of.scores[best]) {
            best[cell] = Some(pixel);
        }
    }
    best.into_iter().flatten().collect()
}

/// Takes the cells of points in photos that see them.
fn take(taken: &mut [Vec<bool>], photos: &[Photo], depths: &[Depths], points: &[[f32; 3]]) {
    taken.par_iter_mut().zip(photos).zip(depths).for_each(|((taken, photo), of)| {
        for point in points {
            let Some((pixel, depth)) = photo.project(DVec3::from(point.map(f64::from))) else { continue };
            if (f64::from(of.depths[pixel]) - depth).abs() < SMOOTHNESS * depth {
                taken[photo.cell(pixel)] = true;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Image, Intrinsics, Pose};

    const WALL: f64 = 4.0;
    const BOX: f64 = 3.0;

    #[test]
    fn points_are_on_surfaces() {
        let cameras = cameras();
        let photos: Vec<Image> = cameras.iter().map(photo).collect();
        let found = added(&photos, &cameras, &sparse());
        assert!(found.len() > 500, "{}", found.len());
        let error = |at: &[f32; 3]| {
            let [x, y, z] = at.map(f64::from);
            // Windows at the box's edges see both surfaces.
            let [inside, around] = [0.7, 1.4].map(|scale| is_box(x / scale, y / scale));
            let surface = if is_box(x, y) { BOX } else { WALL };
            (inside == around).then_some((z / surface - 1.0).abs())
        };
        let mut errors: Vec<f64> = found.iter().filter_map(error).collect();
        errors.sort_unstable_by(f64::total_cmp);
        // At the wall, planes are 1.2 % of the depth apart.
        assert!(errors[errors.len() / 2] < 0.001 && errors[errors.len() * 39 / 40] < 0.01, "{errors:?}");
        let in_front = found.iter().filter(|at| at[2] < 3.5).count();
        assert!(in_front > 100, "{in_front}");
        assert!(added(&photos, &cameras, &sparse()) == found);
        let at_most = |most: usize| {
            let cloud = stereo_points(&photos, &cameras, &sparse(), Some(most), |_| ControlFlow::Continue(()));
            cloud.expect("points").positions
        };
        assert!(at_most(0) == sparse().positions && at_most(48) == sparse().positions);
        let some = at_most(148);
        assert!(some.len() == 148 && some[48..].iter().all(|at| found.contains(at)));
        assert!(at_most(48 + found.len())[48..] == found);
    }

    #[test]
    fn points_are_where_none_were() {
        let cameras = cameras();
        let photos: Vec<Image> = cameras.iter().map(photo).collect();
        let found = added(&photos, &cameras, &sparse());
        let mut cloud = sparse();
        // The right half is full.
        let full = (0..40_000).map(|i| [0.02 * (i % 200) as f32, 0.02 * (i / 200) as f32 - 2.0, WALL as f32]);
        cloud.positions.extend(full.filter(|at| !is_box(at[0].into(), at[1].into())));
        let right = |points: &[[f32; 3]]| points.iter().filter(|at| at[0] > 0.8).count();
        let fewer = added(&photos, &cameras, &cloud);
        assert!(10 * right(&fewer) < right(&found), "{} of {}", right(&fewer), right(&found));
        let hidden = photos.iter().map(|photo| photo.clone().with_mask(vec![0; photo.rgb.len() / 3]).expect("a mask"));
        assert_eq!(added(&hidden.collect::<Vec<_>>(), &cameras, &sparse()).len(), 0);
    }

    #[test]
    fn photos_that_disagree_add_nothing() {
        let cameras = cameras();
        let mut random = crate::random::Random::new(7);
        let mut noise =
            || Image::new(120, 90, (0..32_400).map(|_| random.below(256) as u8).collect()).expect("a photo");
        let photos: Vec<Image> = cameras.iter().map(|_| noise()).collect();
        assert_eq!(added(&photos, &cameras, &sparse()).len(), 0);
        let flat = vec![Image::new(120, 90, vec![90; 32_400]).expect("a photo"); cameras.len()];
        assert_eq!(added(&flat, &cameras, &sparse()).len(), 0);
        let photos: Vec<Image> = cameras.iter().map(photo).collect();
        assert_eq!(added(&photos[..2], &cameras[..2], &sparse()).len(), 0);
        assert_eq!(added(&photos, &cameras, &PointCloud::default()).len(), 0);
        let stopped = stereo_points(&photos, &cameras, &sparse(), None, |_| ControlFlow::Break(()));
        assert!(matches!(stopped, Err(Error::Cancelled)));
    }

    fn added(photos: &[Image], cameras: &[Camera], cloud: &PointCloud) -> Vec<[f32; 3]> {
        let joined =
            stereo_points(&photos, cameras, cloud, Some(usize::MAX), |_| ControlFlow::Continue(())).expect("points");
        assert_eq!(joined.positions.len(), joined.colors.len());
        let (given, added) = joined.positions.split_at(cloud.positions.len());
        assert_eq!(given, cloud.positions);
        added.to_vec()
    }

    fn sparse() -> PointCloud {
        let at = |i: usize| [0.5 * (i % 8) as f32 - 1.75, 0.5 * (i / 8) as f32 - 1.25];
        let point = |[x, y]: [f32; 2]| [x, y, if is_box(x.into(), y.into()) { BOX } else { WALL } as f32];
        PointCloud { positions: (0..48).map(|i| point(at(i))).collect(), colors: Vec::new() }
    }

    fn cameras() -> Vec<Camera> {
        let intrinsics = Intrinsics::from_fov(120, 90, 0.9, 0.7);
        let camera = |i: usize| {
            let translation = DVec3::new(0.4 * i as f64 - 0.8, 0.1 * (i % 2) as f64, 0.0);
            Camera { intrinsics, pose: Pose { translation, ..Pose::IDENTITY } }
        };
        (0..5).map(camera).collect()
    }

    fn is_box(x: f64, y: f64) -> bool {
        x.abs() < 0.5 && y.abs() < 0.4
    }

    /// A textured wall with a box before it.
    fn photo(camera: &Camera) -> Image {
        let i = &camera.intrinsics;
        let gray = |pixel: u32| {
            let [x, y] = [pixel % i.width, pixel / i.width].map(|at| f64::from(at) + 0.5);
            let ray = DVec3::new((x - i.cx) / i.fx, (y - i.cy) / i.fy, 1.0);
            let at = |depth: f64| camera.pose.transform(depth * ray);
            let front = at(BOX);
            let (at, phase) = if is_box(front.x, front.y) { (front, 1.0) } else { (at(WALL), 0.0) };
            let waves = [(7.0, 3.0), (-5.0, 9.0), (13.0, -4.0), (2.0, -11.0)];
            let sum: f64 = waves.iter().map(|(u, v)| (u * at.x + v * at.y + phase).sin()).sum();
            [(128.0 + 30.0 * sum) as u8; 3]
        };
        Image::new(i.width, i.height, (0..i.width * i.height).flat_map(gray).collect()).expect("a photo")
    }
}
