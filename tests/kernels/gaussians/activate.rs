//! Activations of Gaussians: goldens, random values, extremes.

use crate::case::{Case, random};
use zipsplat::kernels::limits::GROUP_FOLD;
use zipsplat::stages::{gaussians, render::SceneTensors};
use zipsplat_tests::compare::{Tolerance, assert_close, assert_gaussians_close, assert_same};
use zipsplat_tests::golden::Golden;
use zipsplat_tests::reference::{gaussians::activate::activate, widen};

/// Activates `raw` `[count, 11 + 3 (degree + 1)^2]` on the device.
fn activated(raw: &[f32], sh_degree: usize) -> Vec<f32> {
    activated_in(1.0, raw, sh_degree)
}

/// [`activated`] at another scene scale.
fn activated_in(unit: f32, raw: &[f32], sh_degree: usize) -> Vec<f32> {
    let bases = (sh_degree + 1) * (sh_degree + 1);
    let count = raw.len() / (11 + 3 * bases);
    let mut case = Case::new();
    let input = case.input(raw);
    let unit = case.input(&[unit]);
    let scene = SceneTensors::output(&mut case.rec, count, sh_degree as u32);
    gaussians::activate(&mut case.rec, input, unit, &scene);
    let tensors = [scene.means, scene.scales, scene.quats, scene.opacities, scene.sh_coeffs];
    let run = case.run();
    let fields = tensors.map(|tensor| run.read::<f32>(tensor).unwrap());
    let widths = [3, 3, 4, 1, 3 * bases];
    let field = |i: usize, (values, width): (&Vec<f32>, usize)| values[i * width..(i + 1) * width].to_vec();
    (0..count).flat_map(|i| fields.iter().zip(widths).flat_map(move |values| field(i, values))).collect()
}

fn truth(raw: &[f32], width: usize) -> Vec<f64> {
    widen(raw).chunks(width).flat_map(activate).collect()
}

/// Returns a Gaussian of SH degree 0 with `values` from `column` on, zero elsewhere.
fn with(column: usize, values: &[f32]) -> Vec<f32> {
    let mut raw = vec![0.0; 14];
    raw[column..column + values.len()].copy_from_slice(values);
    raw
}

/// Compares each value by itself.
fn check_each(name: &str, raw: &[f32], columns: std::ops::Range<usize>) {
    for ((raw, got), truth) in raw.chunks(14).zip(activated(raw, 0).chunks(14)).zip(truth(raw, 14).chunks(14)) {
        for c in columns.clone() {
            assert_close(&format!("{name} of {}", raw[c]), &[got[c]], &[truth[c]], Tolerance::EXPONENTIAL);
        }
    }
}

#[test]
fn equals_the_goldens() {
    let golden = Golden::committed("geometry.safetensors");
    let (raw, width) = (golden.f32("head/raw"), golden.shape("head/gauss")[1]);
    assert_gaussians_close("head", &activated(&raw, 1), &golden.f32("head/gauss"), width);
}

#[test]
fn equals_the_reference() {
    for (sh_degree, width) in [(0, 14), (1, 23), (2, 38), (3, 59)] {
        for count in [0, 1, 63, 64, 65, 333] {
            let raw: Vec<f32> = random(1, count * width).iter().map(|x| 6.0 * x).collect();
            let name = format!("{count} of degree {sh_degree}");
            assert_gaussians_close(&name, &activated(&raw, sh_degree), &truth(&raw, width), width);
        }
    }
}

#[test]
fn more_workgroups_than_fit_in_a_row() {
    let count = GROUP_FOLD as usize * 64 + 65;
    let raw = random(2, count * 14);
    let got = activated(&raw, 0);
    // First and last rows of folded workgroups; the reference is too slow for all.
    for range in [0..1000, count - 1000..count] {
        let values = range.start * 14..range.end * 14;
        let name = format!("{range:?}");
        assert_gaussians_close(&name, &got[values.clone()], &truth(&raw[values], 14), 14);
    }
    assert!(got.iter().all(|x| x.is_finite()));
}

#[test]
fn means_near_and_far() {
    let magnitudes = [0.0, 1e-30, 1e-20, 1e-8, 1e-5, 1e-3, 0.1, 0.2, 0.34, 0.35, 0.36, 0.5, 0.69, 1.0, 2.0, 4.999];
    let raw: Vec<f32> = magnitudes.iter().flat_map(|&x| with(0, &[x, -x, x])).collect();
    check_each("mean", &raw, 0..3);
}

#[test]
fn scales_over_their_whole_range() {
    // softplus(x - 4): exp, then log(1 + u) until 1 + u rounds to 1, then the identity above 20.
    let raw: Vec<f32> =
        (-100..=100).flat_map(|x| with(3, &[x as f32, x as f32 / 10.0, 4.0 + x as f32 / 1000.0])).collect();
    check_each("scale", &raw, 3..6);
}

#[test]
fn clamps_are_exact() {
    let far = activated(&[with(0, &[5.0, 100.0, 1e30]), with(0, &[-5.0, -100.0, -1e30])].concat(), 0);
    for side in far.chunks(14) {
        assert_eq!([side[1], side[2]], [side[0]; 2], "means beyond +-5 are those at +-5");
        assert_close("mean", &[side[0].abs()], &[5f64.exp_m1()], Tolerance::EXPONENTIAL);
    }
    let scales = activated(&with(3, &[-100.0, -20.0, 100.0]), 0);
    assert_same("scales", &scales[3..6], &[1e-6, 1e-6, 15.0]);
}

#[test]
fn quaternions_of_any_length() {
    let direction = [0.5f32, -0.1, 0.7, 0.3];
    for length in [1e-30f32, 1e-20, 1e-13, 1e-12, 1e-11, 1e-3, 1.0, 1e3, 1e19, 1e20, 1e37] {
        let raw = with(6, &direction.map(|x| x * length));
        let (got, truth) = (activated(&raw, 0), truth(&raw, 14));
        assert_close(&format!("quaternion of length {length:e}"), &got[6..10], &truth[6..10], Tolerance::ELEMENTWISE);
    }
    assert_same("no quaternion", &activated(&with(0, &[]), 0)[6..10], &[0.0; 4]);
    let one = &activated(&with(6, &[0.0, 0.0, -7.0, 0.0]), 0)[6..10];
    assert_close("one component", one, &[0.0, 0.0, -1.0, 0.0], Tolerance::ELEMENTWISE);
}

#[test]
fn opacities_saturate() {
    let raw: Vec<f32> = (-100..=100).flat_map(|x| with(10, &[x as f32])).collect();
    let opacities = |packed: &[f32]| packed.chunks(14).map(|g| g[10]).collect::<Vec<_>>();
    let got = opacities(&activated(&raw, 0));
    let truth: Vec<f64> = truth(&raw, 14).chunks(14).map(|g| g[10]).collect();
    assert_close("opacities", &got, &truth, Tolerance::EXPONENTIAL);
    assert_eq!((got[100], got[200]), (0.5, 1.0));
    assert!(got.iter().all(|x| (0.0..=1.0).contains(x)));
}

#[test]
fn lengths_are_in_the_unit_and_nothing_else_is() {
    let raw = random(11, 14 * 70);
    let (plain, scaled) = (activated(&raw, 0), activated_in(2.5, &raw, 0));
    for (plain, scaled) in plain.chunks(14).zip(scaled.chunks(14)) {
        let lengths: Vec<f32> = plain[..6].iter().map(|value| 2.5 * value).collect();
        assert_same("lengths", &scaled[..6], &lengths);
        assert_same("the rest", &scaled[6..], &plain[6..]);
    }
}
