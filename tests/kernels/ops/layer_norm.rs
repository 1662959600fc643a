//! Layer normalization against two passes in f64.

use crate::case::{Case, elements, random};
use zipsplat::{
    gpu::{Element, Limits},
    ops::{Norm, Rows},
};
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::device::device;
use zipsplat_tests::golden::Golden;
use zipsplat_tests::reference::{
    ops::{add::add, layer_norm::layer_norm},
    widen,
};

/// Two sums over a row, a root and a division.
fn tolerance(width: usize) -> Tolerance {
    Tolerance::sum_of(width).and(Tolerance::ELEMENTWISE)
}

fn norm(case: &mut Case, weight: &[f32], bias: &[f32], eps: f32) -> Norm {
    Norm { weight: case.input(weight), bias: case.input(bias), width: weight.len(), eps }
}

/// Checks the norm of packed rows `x` (+ `addend`) with random weights.
fn check(name: &str, x: &[f32], addend: Option<&[f32]>, width: usize, eps: f32, tolerance: Tolerance) {
    let (weight, bias) = (random(91, width), random(92, width));
    let sum = addend.map_or(widen(x), |addend| add(&widen(x), &widen(addend)));
    let truth = layer_norm(&sum, &weight, &bias, f64::from(eps));
    for output in elements() {
        let mut case = Case::new();
        let norm = norm(&mut case, &weight, &bias, eps);
        let out = case.output_of(output, x.len());
        let rows = |tensor| Rows::new(tensor, x.len() / width, width);
        let (source, addend) = (rows(case.input(x)), addend.map(|a| rows(case.input(a))));
        norm.record(&mut case.rec, source, addend, Rows { element: output, ..rows(out) }, 0);
        assert_close(&format!("{name} {output:?}"), &case.result_of(output, out), &truth, tolerance.stored_in(output));
    }
}

#[test]
fn equals_the_reference() {
    // Around any subgroup size and its multiples, and the largest networks' widths.
    for width in [1, 3, 4, 7, 8, 9, 31, 32, 33, 63, 64, 65, 127, 384, 1536, 3073] {
        for rows in [0, 1, 5] {
            let (x, addend) = (random(1, rows * width), random(2, rows * width));
            check(&format!("{rows} x {width}"), &x, None, width, 1e-6, tolerance(width));
            check(&format!("{rows} x {width} + addend"), &x, Some(&addend), width, 1e-5, tolerance(width));
        }
    }
}

#[test]
fn rows_beyond_the_most_workgroups() {
    check("65,537 x 4", &random(3, 65_537 * 4), None, 4, 1e-5, tolerance(4));
}

#[test]
fn epsilons_are_told_apart() {
    // Variances comparable to epsilon.
    let x: Vec<f32> = random(4, 20 * 64).iter().map(|x| 2e-3 * x).collect();
    for eps in [1e-5, 1e-6] {
        check(&format!("eps {eps:e}"), &x, None, 64, eps, tolerance(64));
    }
}

#[test]
fn constant_rows_give_the_bias() {
    for value in [0.0f32, 1.0, -3.0, 1e4] {
        for width in [1, 4, 33, 64] {
            // Only the rounding of the mean remains, divided by the root of epsilon.
            let ratio = f64::from(value.abs()) / 1e-5f64.sqrt();
            let tolerance = tolerance(width).and(Tolerance::mean_of(width).times(ratio));
            check(&format!("all {value}, {width}"), &vec![value; 3 * width], None, width, 1e-5, tolerance);
        }
    }
}

#[test]
fn a_mean_far_above_the_spread() {
    // A variance from a difference of sums would be off by more than itself.
    for (spread, width) in [(1.0, 384), (1e-2, 64)] {
        let x: Vec<f32> = random(5, 40 * width).iter().map(|x| 1e4 + spread * x).collect();
        let tolerance = tolerance(width).and(Tolerance::mean_of(width).times(1e4 / f64::from(spread)));
        check(&format!("1e4 +- {spread}"), &x, None, width, 1e-6, tolerance);
    }
}

#[test]
fn equals_the_goldens() {
    let golden = Golden::committed("geometry.safetensors");
    let (x, weight, bias) = (golden.f32("ops/ln_x"), golden.f32("ops/ln_w"), golden.f32("ops/ln_b"));
    let width = weight.len();
    for (eps, key) in [(1e-5, "ops/ln_1e-05"), (1e-6, "ops/ln_1e-06")] {
        let mut case = Case::new();
        let norm = norm(&mut case, &weight, &bias, eps);
        let input = Rows::new(case.input(&x), x.len() / width, width);
        let out = norm.apply(&mut case.rec, input, Element::F32).tensor;
        case.rec.output(out);
        assert_close(key, &case.result::<f32>(out), &golden.f32(key), tolerance(width));
    }
}

#[test]
fn skips_camera_tokens_and_writes_between_other_columns() {
    let (patches, width, stride, column) = (6, 20, 53, 30);
    let (weight, bias) = (random(6, width), random(7, width));
    // The narrow limit splits the rows into parts of 64 views.
    for (views, max_binding_bytes) in [(1, u64::MAX), (3, u64::MAX), (150, 100 << 10)] {
        let x = random(8, views * (1 + patches) * width);
        let limits = device().limits();
        let max_binding_bytes = limits.max_binding_bytes.min(max_binding_bytes);
        let mut case = Case::within(&Limits { max_binding_bytes, ..limits.clone() });
        let norm = norm(&mut case, &weight, &bias, 1e-5);
        let rows = views * patches;
        let input = Rows::new(case.input(&x), views * (1 + patches), width);
        let out = case.output::<f32>(rows * stride);
        norm.record(&mut case.rec, input, None, Rows::new(out, rows, stride).columns(column, width), patches);
        let got: Vec<f32> = case.result(out);

        let tokens = x.chunks(width).enumerate().filter(|(row, _)| row % (1 + patches) != 0);
        let kept: Vec<f32> = tokens.flat_map(|(_, token)| token).copied().collect();
        let truth = layer_norm(&widen(&kept), &weight, &bias, 1e-5);
        let written: Vec<f32> = got.chunks(stride).flat_map(|row| &row[column..column + width]).copied().collect();
        assert_close(&format!("{views} views"), &written, &truth, tolerance(width));
        let untouched = got.chunks(stride).all(|r| r[..column].iter().chain(&r[column + width..]).all(|x| x.is_nan()));
        assert!(untouched, "{views} views: other columns were written");
    }
}
