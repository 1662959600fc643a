use crate::case::*;
use zipsplat::ops::measure;
use zipsplat_tests::reference::measure::copy::copy;

#[test]
fn every_byte_is_copied() {
    // The last exceeds one row of workgroups.
    for quads in [0, 1, 63, 65, 64 * 70_000 + 3] {
        let source: Vec<u32> = (0..4 * quads as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let mut case = plan();
        let from = case.input(&source);
        let out: Tensor = measure::copy(&mut case.rec, from);
        assert_same(&format!("{quads} quads"), &case.result::<u32>(out).unwrap(), &copy(&source));
    }
}
