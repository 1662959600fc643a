//! Means of halves, exactly: one rounding, then a factor of a power of two.

use crate::case::{Case, random, rounded};
use zipsplat::kernels::backbone::AverageHalves;
use zipsplat_tests::compare::assert_same;
use zipsplat_tests::reference::{backbone::average_halves::average_halves, widen};

#[test]
fn equals_the_reference() {
    for (rows, width) in [(0, 4), (1, 1), (21, 3), (8, 8), (13, 5), (65_537, 65)] {
        let halves = random(1, rows * 2 * width);
        let mut case = Case::new();
        let out = case.output::<f32>(rows * width);
        let kernel = AverageHalves { halves: case.input(&halves), out, rows: rows as u32, width: width as u32 };
        case.rec.dispatch(kernel, rows * width);
        let truth = rounded(&average_halves(&widen(&halves), width));
        assert_same(&format!("{rows} x {width}"), &case.result::<f32>(out), &truth);
    }
}
