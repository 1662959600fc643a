//! A procedural capture whose photos differ in exposure.

use super::*;
use zipsplat::{
    refine::Exposure,
    types::{ColorTransform, PointCloud, read_points},
};
use zipsplat_cli::procedural::{Options, Photos, Setup, write_folder};

const VIEWS: usize = 14;
pub const HELD_OUT: [usize; 2] = [3, 10];

pub struct Shot {
    pub cameras: Vec<Camera>,
    pub images: Vec<Image>,
    pub cloud: PointCloud,
}

pub fn shot() -> Shot {
    let options = Options { views: VIEWS, width: 96, height: 96, supersample: false, random_first: false };
    let setup = Setup::new(1, &options, &Photos::default(), &|| Ok(())).unwrap();
    let capture = setup.shoot(&Photos::default(), &|| Ok(())).unwrap();
    let folder = tempfile::tempdir().unwrap();
    write_folder(folder.path(), &capture, &[]).unwrap();
    let cloud = read_points(folder.path().join("points.ply")).unwrap();
    Shot { cameras: capture.cameras, images: capture.images, cloud }
}

/// Linear light times a power of 2, with clipping highlights.
fn exposed(image: &Image, stops: f64) -> Image {
    let byte = |value: &u8| {
        let value = f64::from(*value) / 255.0;
        let linear = if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
        let linear = linear * stops.exp2();
        let value = if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        (value.clamp(0.0, 1.0) * 255.0).round() as u8
    };
    Image { rgb: image.rgb.iter().map(byte).collect(), mask: None, ..*image }
}

/// Twelve exposures from -1 to 1 stops, shuffled; held-out photos have 0.
fn photos_of_exposures(images: &[Image]) -> Vec<Image> {
    let training = (0..VIEWS).filter(|i| !HELD_OUT.contains(i)).enumerate();
    let mut photos = images.to_vec();
    training.for_each(|(k, i)| photos[i] = exposed(&images[i], (5 * k % 12) as f64 / 5.5 - 1.0));
    photos
}

fn refined(shot: &Shot, photos: &[Image], exposure: Exposure) -> RefineResult {
    let scene = Scene::from_points(&shot.cloud, &shot.cameras).unwrap();
    let request = RefineOptions {
        length: RefineLength::Steps(80),
        max_gaussians: Some(0),
        holdout_views: Some(HELD_OUT.len()),
        exposure,
        ..RefineOptions::default()
    };
    let refined = refine(&scene, photos, &shot.cameras, &request);
    assert_eq!(refined.holdout_views, HELD_OUT);
    refined
}

/// Held-out PSNR in dB, after color correction if asked for.
pub fn held_out_psnr(shot: &Shot, scene: &Scene, corrects: bool) -> f64 {
    let psnr = |i: &usize| {
        let [drawn, photo] = pair(scene, &shot.cameras[*i], &shot.images[*i]);
        let corrected = if corrects { ColorTransform::fit(&drawn, &photo).apply(&drawn) } else { drawn };
        let squares = corrected.iter().zip(&photo).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
        -10.0 * (squares / photo.len() as f64).log10()
    };
    HELD_OUT.iter().map(psnr).sum::<f64>() / HELD_OUT.len() as f64
}

#[test]
fn learned_exposures_are_as_good_as_a_constant_one() {
    let shot = shot();
    let photos = photos_of_exposures(&shot.images);
    let [without, with, again] =
        [Exposure::Off, Exposure::On, Exposure::Auto].map(|exposure| refined(&shot, &photos, exposure));
    let [constant, same] = [Exposure::Off, Exposure::Auto].map(|exposure| refined(&shot, &shot.images, exposure));
    let [best, without_db, with_db] =
        [&constant, &without, &with].map(|refined| held_out_psnr(&shot, &refined.scene, true));
    println!("{best:.2} dB of a constant exposure; of twelve {without_db:.2} dB without, {with_db:.2} dB with");
    assert!(with_db > without_db + 1.0 && with_db > best - 0.3, "{best}, {without_db} and {with_db} dB");
    assert!(again.scene == with.scene && again.exposures == with.exposures, "the same bits");
    assert!(same.scene == constant.scene && [same.exposures, without.exposures] == [None, None]);

    let exposures = with.exposures.unwrap();
    HELD_OUT.iter().for_each(|i| assert_eq!(exposures[*i], ColorTransform::IDENTITY));
    for number in 0..12 {
        let of = |exposure: &ColorTransform| f64::from(exposure.0.as_flattened()[number]);
        let mean = (0..VIEWS).map(|i| of(&exposures[i])).sum::<f64>() / VIEWS as f64;
        assert!((mean - of(&ColorTransform::IDENTITY)).abs() < 1e-6, "number {number}: a mean of {mean}");
    }
    // 1.9 times, between black and white.
    let gray = |i: usize| exposures[i].apply(&[0.4; 3]).iter().sum::<f32>();
    assert!(gray(8) > 1.4 * gray(0), "{} and {}", gray(8), gray(0));
}
