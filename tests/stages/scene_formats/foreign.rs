//! Made from `gaussians_deg2.ply`.

use super::{assert_rotations, assert_within, coefficient};
use zipsplat::types::read_ply;
use zipsplat_tests::prelude::*;

fn pair(name: &str) -> (Scene, Scene) {
    let read = |name: &str| golden::find(name).unwrap();
    (Scene::open(read(name)).unwrap(), read_ply(read("gaussians_deg2.ply")).unwrap())
}

#[test]
fn spz() {
    for (version, rotation) in [(2, 4.0 * 3f64.sqrt() / 255.0), (3, 0.01), (4, 0.01)] {
        let (found, truth) = pair(&format!("scenes/v{version}.spz"));
        assert_eq!((found.len(), found.sh_degree), (7, 2));
        // 12 fractional bits.
        assert_within("mean", found.means.as_flattened(), truth.means.as_flattened(), |_| 0.501 / 4096.0);
        let scales: Vec<f32> = truth.scales.iter().flatten().map(|scale| scale.max((-10f32).exp())).collect();
        let step = (1.001 / 32.0f32).exp() - 1.0;
        assert_within("scale", found.scales.as_flattened(), &scales, |truth| step * truth);
        assert_within("opacity", &found.opacities, &truth.opacities, |_| 1.001 / 510.0);
        assert_within("color", &coefficient(&found, 0), &coefficient(&truth, 0), |_| 1.001 / (510.0 * 0.15));
        assert_rotations(&found.quats, &truth.quats, rotation);
        for k in 1..9 {
            // Some writers truncate. Flipped axes swap the ends of the range.
            let levels = if k < 4 { 8.5 } else { 16.5 };
            let clamped: Vec<f32> = coefficient(&truth, k).iter().map(|value| value.clamp(-1.0, 1.0)).collect();
            assert_within(&format!("sh {k}"), &coefficient(&found, k), &clamped, |_| levels / 128.0);
        }
    }
}

#[test]
fn packed_ply() {
    let (found, truth) = pair("scenes/scene.compressed.ply");
    assert_eq!((found.len(), found.sh_degree), (7, 2));
    // Sorted spatially.
    let distance = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    let nearest = |mean: &[f32; 3]| {
        (0..7).min_by(|a, b| distance(&truth.means[*a], mean).total_cmp(&distance(&truth.means[*b], mean))).unwrap()
    };
    let order: Vec<usize> = found.means.iter().map(nearest).collect();
    let mut truth = truth;
    truth.keep(&order);
    let reach = |values: &[f32]| {
        let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(*v), high.max(*v)));
        high - low
    };
    let ln = |scene: &Scene| scene.scales.as_flattened().iter().map(|scale| scale.ln()).collect::<Vec<_>>();
    let step = |values: &[f32], levels: f32| 0.51 * reach(values) / (levels - 1.0) + 1e-5;
    let [position, scale] = [truth.means.as_flattened(), &ln(&truth)].map(|values| step(values, 1024.0));
    assert_within("mean", found.means.as_flattened(), truth.means.as_flattened(), |_| position);
    assert_within("scale", &ln(&found), &ln(&truth), |_| scale);
    assert_within("opacity", &found.opacities, &truth.opacities, |_| 0.51 / 255.0);
    let color = step(&coefficient(&truth, 0), 256.0);
    assert_within("color", &coefficient(&found, 0), &coefficient(&truth, 0), |_| color);
    assert_rotations(&found.quats, &truth.quats, 0.01);
    for k in 1..9 {
        // The middle of a bucket of 256; the first and last are the range's ends.
        let clamped: Vec<f32> = coefficient(&truth, k).iter().map(|value| value.clamp(-4.0, 4.0)).collect();
        assert_within(&format!("sh {k}"), &coefficient(&found, k), &clamped, |_| 1.01 * 8.0 / 256.0);
    }
}

#[test]
fn splat() {
    let (found, truth) = pair("scenes/scene.splat");
    assert_eq!((&found.means, found.sh_degree), (&truth.means, 0));
    assert_within("scale", found.scales.as_flattened(), truth.scales.as_flattened(), |truth| 1e-6 * truth);
    // This writer truncates.
    assert_within("opacity", &found.opacities, &truth.opacities, |_| 1.001 / 255.0);
    assert_rotations(&found.quats, &truth.quats, 4.0 / 128.0);
    let color = |dc: &f32| (0.5 + 0.282_094_8 * dc).clamp(0.0, 1.0);
    let colors = |scene: &Scene| coefficient(scene, 0).iter().map(color).collect::<Vec<f32>>();
    assert_within("color", &colors(&found), &colors(&truth), |_| 1.001 / 255.0);
}

#[test]
fn glb() {
    let (found, truth) = pair("scenes/scene.glb");
    assert_eq!((&found.means, &found.sh_coeffs, found.sh_degree), (&truth.means, &truth.sh_coeffs, 2));
    assert_within("scale", found.scales.as_flattened(), truth.scales.as_flattened(), |truth| 1e-6 * truth);
    assert_within("opacity", &found.opacities, &truth.opacities, |_| 1e-6);
    // Only axis names differ.
    let (found, truth) = (covariances(&found), covariances(&truth));
    assert!(
        found.iter().zip(&truth).all(|(found, truth)| found.abs_diff_eq(*truth, 1e-6 * (1.0 + truth.x_axis.length())))
    );
}

/// `R S Sᵀ Rᵀ`.
fn covariances(scene: &Scene) -> Vec<DMat3> {
    let covariance = |(quat, scales): (&[f32; 4], &[f32; 3])| {
        let rotation = matrix_from_quaternion(quat.map(f64::from));
        rotation * DMat3::from_diagonal(scales.map(|scale| f64::from(scale).powi(2)).into()) * rotation.transpose()
    };
    scene.quats.iter().zip(&scene.scales).map(covariance).collect()
}
