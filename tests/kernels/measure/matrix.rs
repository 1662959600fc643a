//! Matrix products of small integers, exact: sums stay far below 2^24.

use crate::case::*;
use zipsplat::{ops::Units, ops::measure::MatrixProducts};
use zipsplat_tests::reference::measure::matrix::products;

#[test]
fn every_product_is_added() {
    let limits = device().limits();
    let factors = Element::FACTORS;
    for units in factors.into_iter().filter_map(|factor| Units::of(factor, limits)) {
        for (groups, iterations, swaps) in [(1, 0, 0), (1, 1, 1), (3, 2, 1), (2, 70, 0x8000_0005), (300, 1000, 0)] {
            check(MatrixProducts { units, subgroups: groups * MatrixProducts::SUBGROUPS, iterations, swaps });
        }
    }
}

fn check(of: MatrixProducts) {
    let (limits, shape) = (device().limits(), of.units.shape);
    let [m, n, k] = [shape.m, shape.n, shape.k].map(|side| side as usize);
    let whole = |seed, len| -> Vec<f32> { random_below(seed, len, 9).into_iter().map(|v| v as f32 - 4.0).collect() };
    let (a, b) = (whole(1, 2 * m * k), whole(2, MatrixProducts::products(limits) * k * n));
    let mut case = plan();
    let [left, right] = [&a, &b].map(|values| case.input_of(of.units.factor, values));
    let out = of.record(&mut case.rec, left, right);
    let one = rounded(&products(&widen(&a), &widen(&b), [m, n, k], of.iterations, of.swaps));
    assert_same(&format!("{of:?}"), &of.sums(case.result(out).unwrap()), &one.repeat(of.subgroups));
    let each = 2 * m * n * k * MatrixProducts::products(limits);
    assert_eq!(of.flops(limits), (each * of.subgroups) as u64 * u64::from(of.iterations));
}
