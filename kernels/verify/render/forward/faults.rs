use super::picture::{gaussians, reference_camera};
use crate::bound::half;
use glam::DVec3;
use rayon::prelude::*;
use zipsplat::types::{Camera, Scene};
use zipsplat_reference::render::{
    project::{Camera as Pinhole, Gaussians, Splat, project},
    rasterize::{Pixel, Rules, alpha, blend},
    sh,
};

#[derive(Clone, Copy, Debug)]
pub enum Fault {
    Blank,
    /// No output, not even the background.
    Unwritten,
    LastTile,
    Missing,
    BackToFront,
    HalfPixel,
    NeighborColor,
    HalfColors,
    NegativeColors,
    NoBands,
    DirectionInCamera,
    OtherAntialiasing,
    Unrotated,
    /// Determinants as differences of products in f32.
    CancellingDeterminant,
    BehindDrawn,
    NearDrawn,
    FaintDrawn,
    OpaqueUnclamped,
    NeverStops,
    CenteredPrincipal,
    TransposedPixels,
    /// Tile indices wrap at 65,536.
    TilesWrap,
}

/// Color, alpha, accumulated depth.
pub type Picture = [Vec<f32>; 3];

/// `before` is the camera of the tiles from 0 on.
pub fn wrong(scene: &Scene, camera: &Camera, antialiased: bool, fault: Fault, before: Option<&Camera>) -> Picture {
    let (mut scene, mut camera, mut antialiased, mut rules) =
        (gaussians(scene), *camera, antialiased, Rules::default());
    let i = &mut camera.intrinsics;
    match fault {
        Fault::OtherAntialiasing => antialiased = !antialiased,
        Fault::Unrotated => scene.quats.fill([1.0, 0.0, 0.0, 0.0]),
        Fault::BehindDrawn => scene.means.iter_mut().for_each(|mean| mean[2] = mean[2].abs()),
        Fault::NearDrawn => scene.means.iter_mut().for_each(|mean| mean[2] = mean[2].max(0.01)),
        Fault::CenteredPrincipal => (i.cx, i.cy) = (f64::from(i.width) / 2.0, f64::from(i.height) / 2.0),
        Fault::FaintDrawn => rules.min_alpha = 0.0,
        Fault::OpaqueUnclamped => rules.max_alpha = 1.0,
        Fault::NeverStops => rules.min_transmittance = 0.0,
        Fault::TilesWrap => camera = before.copied().unwrap_or(camera),
        _ => {}
    }
    let pinhole = reference_camera(&camera);
    let mut splats: Vec<Splat> = Vec::new();
    for (n, splat) in project(&scene, &pinhole, antialiased).into_iter().enumerate() {
        splats.extend(splat.map(|splat| changed(splat, &scene, n, &pinhole, fault)));
    }
    splats.sort_by(|a, b| (a.depth as f32).total_cmp(&(b.depth as f32)));
    match fault {
        Fault::Missing => drop(most_visible(&splats, pinhole.size).map(|place| splats.remove(place))),
        Fault::BackToFront => splats.reverse(),
        Fault::NeighborColor => {
            let colors: Vec<_> = splats.iter().map(|splat| splat.color).collect();
            let next = colors.iter().cycle().skip(1);
            splats.iter_mut().zip(next).for_each(|(splat, color)| splat.color = *color);
        }
        _ => {}
    }
    let [width, height] = pinhole.size;
    let place = |i: usize| match fault {
        Fault::TransposedPixels => [(i / height) as f64 + 0.5, (i % height) as f64 + 0.5],
        _ => [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5],
    };
    let pixel = |i: usize| {
        let Pixel { rgb: [r, g, b], depth, transmittance, .. } = blend(&splats, place(i), rules);
        [r, g, b, 1.0 - transmittance, depth]
    };
    let mut pixels: Vec<[f64; 5]> = (0..width * height).into_par_iter().map(pixel).collect();
    match fault {
        Fault::Blank => pixels.fill([0.0; 5]),
        Fault::Unwritten => pixels.fill([f64::NAN; 5]),
        Fault::LastTile => blank_last_tile(&mut pixels, width),
        _ => {}
    }
    let plane = |channels: std::ops::Range<usize>| {
        pixels.iter().flat_map(|pixel| pixel[channels.clone()].to_vec()).map(|x| x as f32).collect()
    };
    [plane(0..3), plane(3..4), plane(4..5)]
}

fn changed(mut splat: Splat, scene: &Gaussians, n: usize, camera: &Pinhole, fault: Fault) -> Splat {
    let coeffs = scene.sh_coeffs.len() / scene.means.len();
    let coeffs = &scene.sh_coeffs[n * coeffs..][..coeffs];
    let direction = DVec3::from(scene.means[n]) - camera.center();
    match fault {
        Fault::HalfPixel => splat.mean = splat.mean.map(|at| at + 0.5),
        Fault::HalfColors => splat.color = splat.color.map(half),
        Fault::NoBands => splat.color = sh::color(&coeffs[..3], direction),
        Fault::DirectionInCamera => splat.color = sh::color(coeffs, camera.rotation * direction),
        Fault::NegativeColors => {
            let degree = (coeffs.len() / 3).isqrt() as i32 - 1;
            let basis = sh::basis(degree, direction.normalize());
            splat.color =
                [0, 1, 2].map(|c| 0.5 + basis.iter().zip(coeffs.chunks(3)).map(|(b, k)| b * k[c]).sum::<f64>());
        }
        Fault::CancellingDeterminant => {
            let [a, b, c] = splat.conic;
            let determinant = a * c - b * b;
            let [xx, xy, yy] = [c, -b, a].map(|x| (x / determinant) as f32);
            let determinant = xx * yy - xy * xy;
            splat.conic = [yy / determinant, -xy / determinant, xx / determinant].map(f64::from);
        }
        _ => {}
    }
    splat
}

/// The first with alpha above 1/20 at its nearest pixel, else the most opaque.
fn most_visible(splats: &[Splat], size: [usize; 2]) -> Option<usize> {
    let own = |splat: &Splat| {
        let nearest = [0, 1].map(|axis| splat.mean[axis].floor().clamp(0.0, size[axis] as f64 - 1.0) + 0.5);
        alpha(splat, nearest, Rules::default())
    };
    let most = (0..splats.len()).max_by(|&a, &b| own(&splats[a]).total_cmp(&own(&splats[b])));
    splats.iter().position(|splat| own(splat) > 0.05).or(most)
}

fn blank_last_tile(pixels: &mut [[f64; 5]], width: usize) {
    let Some(last) = pixels.iter().rposition(|pixel| pixel[3] > 0.01) else { return };
    let tile = |i: usize| (i / width / 16, i % width / 16);
    for i in (0..pixels.len()).filter(|&i| tile(i) == tile(last)) {
        pixels[i] = [0.0; 5];
    }
}
