//! GELU and its derivative, within the rounding of x: below -3, 1 + erf cancels.

use crate::case::{Case, random};
use zipsplat::kernels::ops::Gelu;
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::reference::ops::{activation, gelu::gelu_backward};

fn result(source: &[f32], gradient: &[f32], backward: bool) -> Vec<f32> {
    let mut case = Case::new();
    let (out, count) = (case.output::<f32>(source.len()), source.len());
    let kernel =
        Gelu { source: case.input(source), gradient: case.input(gradient), out, count: count as u32, backward };
    case.rec.dispatch(kernel, count);
    case.result(out)
}

#[test]
fn equals_the_reference() {
    for count in [0, 63, 65, 1001] {
        let source: Vec<f32> = random(1, count).iter().map(|x| 8.0 * x).collect();
        let gradient = random(2, count);
        let forward: Vec<f64> = source.iter().map(|&x| activation::gelu(x.into())).collect();
        let pairs = source.iter().zip(&gradient);
        let backward: Vec<f64> = pairs.map(|(&x, &g)| gelu_backward(x.into(), g.into())).collect();
        assert_close("gelu", &result(&source, &gradient, false), &forward, Tolerance::ELEMENTWISE);
        assert_close("its derivative", &result(&source, &gradient, true), &backward, Tolerance::ELEMENTWISE);
    }
}

#[test]
fn far_from_zero_it_is_the_identity_or_nothing() {
    let source = [-1e30f32, -100.0, -14.0, 14.0, 100.0, 1e30];
    assert_eq!(result(&source, &[3.0; 6], true), [0.0, 0.0, 0.0, 3.0, 3.0, 3.0]);
}

#[test]
fn the_reference_is_the_slope_of_gelu() {
    for x in (-60..=60).map(|x| f64::from(x) / 10.0) {
        let slope = (activation::gelu(x + 1e-5) - activation::gelu(x - 1e-5)) / 2e-5;
        assert!((gelu_backward(x, 1.0) - slope).abs() < 1e-9, "at {x}");
    }
}
