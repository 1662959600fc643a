use crate::case::*;
use zipsplat::kernels::ops::Gelu;
use zipsplat_tests::{reference::ops::activation, reference::ops::gelu::gelu_backward};

#[test]
fn far_from_zero_it_is_the_identity_or_nothing() {
    let source = [-1e30f32, -100.0, -14.0, 14.0, 100.0, 1e30];
    let mut case = plan();
    let (source, gradient, out) = (case.input(&source), case.input(&[3.0f32; 6]), case.output::<f32>(6));
    case.rec.dispatch(Gelu { source, gradient, out, count: 6, backward: true, silu: false }, 6u32);
    assert_eq!(case.result::<f32>(out).unwrap(), [0.0, 0.0, 0.0, 3.0, 3.0, 3.0]);
}

#[test]
fn the_reference_is_the_slope_of_gelu() {
    for x in (-60..=60).map(|x| f64::from(x) / 10.0) {
        let slope = (activation::gelu(x + 1e-5) - activation::gelu(x - 1e-5)) / 2e-5;
        assert!((gelu_backward(x, 1.0) - slope).abs() < 1e-9, "at {x}");
    }
}

#[test]
fn silu_is_the_references() {
    let source = random(1, 130).into_iter().map(|x| 12.0 * x).collect::<Vec<f32>>();
    let mut case = plan();
    let (input, out) = (case.input(&source), case.output::<f32>(source.len()));
    let count = source.len() as u32;
    case.rec.dispatch(Gelu { source: input, gradient: input, out, count, backward: false, silu: true }, source.len());
    let truth: Vec<f64> = source.iter().map(|&x| activation::silu(x.into())).collect();
    assert_close("silu", &case.result::<f32>(out).unwrap(), &truth, Tolerance { max: 1e-5, rms: 1e-6 });
}
