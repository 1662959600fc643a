//! Sums, exact: one rounding.

use crate::case::*;
use zipsplat::{kernels::ops::Add, ops};
use zipsplat_tests::reference::ops::add::add;

/// More than 65,535 workgroups of 64, Vulkan's guaranteed limit along an axis.
const MANY: usize = 65_536 * 64 + 1;

fn truth(left: &[f32], right: &[f32]) -> Vec<f32> {
    rounded(&add(&widen(left), &widen(right)))
}

#[test]
fn equals_the_sum() {
    for count in [0, 1, 63, 64, 65, 1001, MANY] {
        let (left, right) = (random(1, count), random(2, count));
        let mut case = plan();
        let out = case.output::<f32>(count);
        let kernel = Add { left: case.input(&left), right: case.input(&right), out, count: count as u32 };
        case.rec.dispatch(kernel, count);
        assert_same(&format!("{count} values"), &case.result::<f32>(out).unwrap(), &truth(&left, &right));
    }
}

#[test]
fn adds_in_place_and_in_parts() {
    let (left, right) = (random(3, 1000), random(4, 1000));
    for binding in [512, u64::MAX] {
        let limits = zipsplat_tests::device::device().limits();
        let max_binding_bytes = limits.max_binding_bytes.min(binding);
        let mut case = plan_within(&zipsplat::gpu::Limits { max_binding_bytes, ..limits.clone() });
        let (target, other) = (case.input(&left), case.input(&right));
        let rows = |tensor| Rows::new(tensor, left.len() / 8, 8);
        ops::add(&mut case.rec, rows(target), rows(other));
        assert_same(
            &format!("bindings of {max_binding_bytes}"),
            &case.result::<f32>(target).unwrap(),
            &truth(&left, &right),
        );
    }
}
