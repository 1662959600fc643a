//! Sums of matrix products, exactly: factors are small whole numbers, sums far below 2^24.

use crate::case::{Case, random_below, rounded};
use zipsplat::{
    gpu::Element,
    ops::{Units, measure::MatrixProducts},
};
use zipsplat_tests::{
    compare::assert_same,
    device::device,
    reference::{measure::matrix::products, widen},
};

#[test]
fn every_product_is_added() {
    let limits = device().limits();
    for units in [Element::F16, Element::I8].into_iter().filter_map(|factor| Units::of(factor, limits)) {
        let [m, n, k] = [units.shape.m, units.shape.n, units.shape.k].map(|side| side as usize);
        let whole =
            |seed, len| -> Vec<f32> { random_below(seed, len, 9).into_iter().map(|v| v as f32 - 4.0).collect() };
        let (a, b) = (whole(1, m * k), whole(2, MatrixProducts::products(limits) * k * n));
        for (groups, iterations, scale) in [(1, 0, 1.0), (1, 1, 1.0), (3, 2, -1.0), (2, 5, 2.0), (300, 1000, 1.0)] {
            let subgroups = groups * MatrixProducts::SUBGROUPS;
            let of = MatrixProducts { factor: units.factor, shape: units.shape, subgroups, iterations, scale };
            let mut case = Case::new();
            let [left, right] = [&a, &b].map(|values| case.input_of(units.factor, values));
            let out = of.record(&mut case.rec, left, right);
            case.rec.output(out);
            let one = rounded(&products(&widen(&a), &widen(&b), [m, n, k], iterations, scale.into()));
            assert_same(&format!("{of:?}"), &of.sums(&case.result::<u32>(out)), &one.repeat(of.subgroups));
            let each = 2 * m * n * k * MatrixProducts::products(limits);
            assert_eq!(of.flops(limits), (each * of.subgroups) as u64 * u64::from(iterations));
        }
    }
}
