use crate::case::*;
use zipsplat::kernels::limits::GROUP_FOLD;
use zipsplat_tests::reference::gaussians::activate::activate as reference;
use zipsplat_verify::activate;

fn activated(raw: &[f32], degree: u32, scale: f32) -> Vec<f32> {
    activate(device(), raw, degree, scale).unwrap()
}

fn truth(raw: &[f32], width: usize) -> Vec<f64> {
    widen(raw).chunks(width).flat_map(reference).collect()
}

#[test]
fn equals_the_goldens() {
    let golden = Golden::committed("geometry.safetensors");
    let (raw, width) = (golden.f32("head/raw"), golden.shape("head/gauss")[1]);
    assert_gaussians_close("head", &activated(&raw, 1, 1.0), &golden.f32("head/gauss"), width);
}

#[test]
fn more_workgroups_than_fit_in_a_row() {
    let count = GROUP_FOLD as usize * 64 + 65;
    let raw = random(2, count * 14);
    let got = activated(&raw, 0, 1.0);
    // First and last rows: the reference is too slow for all.
    for range in [0..1000, count - 1000..count] {
        let values = range.start * 14..range.end * 14;
        let name = format!("{range:?}");
        assert_gaussians_close(&name, &got[values.clone()], &truth(&raw[values], 14), 14);
    }
    assert!(got.iter().all(|x| x.is_finite()));
}

#[test]
fn zeros_give_no_quaternion_and_half_an_opacity() {
    let zeros = activated(&[0.0; 14], 0, 1.0);
    assert_same("no quaternion", &zeros[6..10], &[0.0; 4]);
    assert_eq!(zeros[10], 0.5, "opacity");
}

#[test]
fn lengths_are_in_the_unit_and_nothing_else_is() {
    let raw = random(11, 14 * 70);
    let (plain, scaled) = (activated(&raw, 0, 1.0), activated(&raw, 0, 2.5));
    for (plain, scaled) in plain.chunks(14).zip(scaled.chunks(14)) {
        let lengths: Vec<f32> = plain[..6].iter().map(|value| 2.5 * value).collect();
        assert_same("lengths", &scaled[..6], &lengths);
        assert_same("the rest", &scaled[6..], &plain[6..]);
    }
}
