//! Sums of matrix products, exactly: factors are quarters, sums far below 2^24 of their unit.

use crate::case::{Case, random_below, rounded};
use zipsplat::{gpu::Element, ops::measure::MatrixProducts};
use zipsplat_tests::{
    compare::assert_same,
    device::device,
    reference::{measure::matrix::products, widen},
};

#[test]
fn every_product_is_added() {
    let limits = device().limits();
    let Some(shape) = limits.matrices else { return };
    let [m, n, k] = [shape.m, shape.n, shape.k].map(|side| side as usize);
    let quarters = |seed, len| -> Vec<f32> {
        random_below(seed, len, 9).into_iter().map(|v| (f32::from(v as u16) - 4.0) / 4.0).collect()
    };
    let (a, b) = (quarters(1, m * k), quarters(2, MatrixProducts::products(limits) * k * n));
    for (groups, iterations, scale) in [(1, 0, 1.0), (1, 1, 1.0), (3, 2, -1.0), (2, 5, 0.5), (300, 1000, 1.0)] {
        let of = MatrixProducts { shape, subgroups: groups * MatrixProducts::SUBGROUPS, iterations, scale };
        let mut case = Case::new();
        let [left, right] = [&a, &b].map(|values| case.input_of(Element::F16, values));
        let out = of.record(&mut case.rec, left, right);
        case.rec.output(out);
        let one = rounded(&products(&widen(&a), &widen(&b), [m, n, k], iterations, scale.into()));
        assert_same(&format!("{of:?}"), &case.result::<f32>(out), &one.repeat(of.subgroups));
        let each = 2 * m * n * k * MatrixProducts::products(limits);
        assert_eq!(of.flops(limits), (each * of.subgroups) as u64 * u64::from(iterations));
    }
}
