use crate::case::*;
use zipsplat::refine::record_dropout;

fn shown(limits: &Limits, opacities: &[f32], key: u32) -> Vec<f32> {
    let mut case = plan_within(limits);
    let (tensor, key) = (case.input(opacities), case.input(&[key]));
    let shown = record_dropout(&mut case.rec, tensor, key, 0.25, opacities.len());
    case.result(shown).unwrap()
}

#[test]
fn parts_hide_the_same_gaussians() {
    let narrow = Limits { max_binding_bytes: 1024, ..device().limits().clone() };
    let opacities = vec![0.5; 3000];
    let whole = shown(device().limits(), &opacities, 1);
    assert_same("dropout in parts", &shown(&narrow, &opacities, 1), &whole);
}

#[test]
fn steps_hide_the_fraction_independently() {
    let opacities = vec![1.0; 1 << 16];
    let [first, second] = [1, 2].map(|key| shown(device().limits(), &opacities, key));
    let count = |is_hidden: &dyn Fn(usize) -> bool| (0..opacities.len()).filter(|i| is_hidden(*i)).count() as f64;
    let fraction = |hidden: f64| hidden / opacities.len() as f64;
    let [one, both] = [count(&|i| first[i] == 0.0), count(&|i| first[i] == 0.0 && second[i] == 0.0)];
    // Five standard deviations.
    assert!((fraction(one) - 0.25).abs() < 0.009, "{one}");
    assert!((fraction(both) - 0.0625).abs() < 0.005, "{both}");
}
