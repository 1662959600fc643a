//! A figure walks through a procedural capture.

use super::{
    exposure::{HELD_OUT, Shot, held_out_psnr, shot},
    *,
};
use glam::DVec3;
use zipsplat::refine::Exposure;

/// Centers above the feet, and radii: body and head.
const FIGURE: [([f64; 3], [f64; 3]); 2] =
    [([0.0, -0.3, 0.0], [0.16, 0.3, 0.12]), ([0.0, -0.68, 0.0], [0.1, 0.12, 0.1])];

/// A striped figure is at another place in each photo, and masked.
pub fn figure(images: &[Image], cameras: &[Camera]) -> Vec<Image> {
    let (count, side) = (images.len() as f64, images[0].width as usize);
    let photo = |(i, (image, camera)): (usize, (&Image, &Camera))| {
        let feet = DVec3::new(0.6 * (i as f64 / (count - 1.0) - 0.5), 0.4, 0.6);
        let hit = |at: usize| -> Option<[u8; 3]> {
            let (x, y) = ((at % side) as f64 + 0.5, (at / side) as f64 + 0.5);
            let lens = camera.intrinsics;
            let ray = camera.pose.rotation * DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0);
            FIGURE.into_iter().find_map(|(center, radii)| {
                let radii = DVec3::from(radii);
                let (from, ray) = ((camera.pose.translation - feet - DVec3::from(center)) / radii, ray / radii);
                let (a, b) = (ray.length_squared(), ray.dot(from));
                let root = (b * b - a * (from.length_squared() - 1.0)).sqrt();
                let at = from + (-b - root) / a * ray;
                (root.is_finite() && -b > root)
                    .then(|| if (6.0 * at.y).sin() > 0.0 { [230, 30, 40] } else { [20, 20, 90] })
            })
        };
        let hits: Vec<Option<[u8; 3]>> = (0..side * side).map(hit).collect();
        let mut rgb = image.rgb.clone();
        rgb.chunks_exact_mut(3)
            .zip(&hits)
            .for_each(|(pixel, hit)| pixel.copy_from_slice(&hit.unwrap_or([pixel[0], pixel[1], pixel[2]])));
        let mask = hits.iter().map(|hit| if hit.is_some() { 0 } else { 255 }).collect();
        Image::new(image.width, image.height, rgb).unwrap().with_mask(mask).unwrap()
    };
    images.iter().zip(cameras).enumerate().map(photo).collect()
}

fn refined(shot: &Shot, photos: &[Image], exposure: Exposure) -> RefineResult {
    let scene = Scene::from_points(&shot.cloud, &shot.cameras).unwrap();
    let request = RefineOptions {
        length: RefineLength::Steps(80),
        holdout_views: Some(HELD_OUT.len()),
        exposure,
        ..RefineOptions::default()
    };
    refine(&scene, photos, &shot.cameras, &request)
}

#[test]
fn a_masked_figure_leaves_no_ghost() {
    let shot = shot();
    let masked = figure(&shot.images, &shot.cameras);
    let hidden = |image: &Image| (0..96 * 96).filter(|at| image.ignores(*at)).count();
    let fraction = masked.iter().map(hidden).sum::<usize>() as f64 / (masked.len() * 96 * 96) as f64;
    assert!(fraction > 0.2, "masks of {fraction} of the pixels");
    let bare: Vec<Image> = masked.iter().map(|photo| Image { mask: None, ..photo.clone() }).collect();
    let all = vec![255; 96 * 96];
    let kept: Vec<Image> = shot.images.iter().map(|photo| photo.clone().with_mask(all.clone()).unwrap()).collect();
    let [with, without, clean, same] =
        [&masked, &bare, &shot.images, &kept].map(|photos| refined(&shot, photos, Exposure::Off));
    let [with_db, without_db, clean_db] =
        [&with, &without, &clean].map(|refined| held_out_psnr(&shot, &refined.scene, false));
    println!(
        "{:.0} % masked: {with_db:.2} dB with masks, {without_db:.2} dB without, {clean_db:.2} dB without the figure",
        100.0 * fraction
    );
    assert!(with_db > without_db + 5.0 && with_db > clean_db - 3.0, "{with_db}, {without_db} and {clean_db} dB");
    assert!(same.scene == clean.scene && same.losses == clean.losses, "masks that keep all change no bit");

    // Not even on exposures.
    let mut other = masked.clone();
    other.iter_mut().for_each(|photo| photo.rgb = photo.hidden().rgb.clone());
    let [a, b] = [&masked, &other].map(|photos| refined(&shot, photos, Exposure::On));
    assert!(a.scene == b.scene && a.exposures == b.exposures && a.holdout_psnr == b.holdout_psnr);
}
