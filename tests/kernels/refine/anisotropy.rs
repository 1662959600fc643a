use crate::case::*;
use zipsplat::refine::{Adam, record_anisotropy_limit};

fn limited(limits: &Limits, scales: &[f32]) -> Vec<f32> {
    let mut case = plan_within(limits);
    let (tensor, schedule) = (case.input(scales), case.input(&Adam::default().schedule(0.5, 1)));
    record_anisotropy_limit(&mut case.rec, tensor, schedule, 5.0, 0.2, scales.len() / 3);
    case.result(tensor).unwrap()
}

#[test]
fn parts_give_the_same_bits() {
    let narrow = Limits { max_binding_bytes: 1024, ..device().limits().clone() };
    let scales: Vec<f32> = random(1, 3000).iter().map(|x| 1e3f32.powf(*x)).collect();
    let whole = limited(device().limits(), &scales);
    assert_same("limits in parts", &limited(&narrow, &scales), &whole);
    assert_ne!(whole, scales);
}
