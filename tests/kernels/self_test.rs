//! The self-test of fast kernels, and what follows from it.

use zipsplat::gpu::{Device, DeviceOptions, Element};
use zipsplat::ops::{Chosen, Precision, SelfTest};
use zipsplat_tests::device::device;

#[test]
fn every_kernel_of_this_device_passes() {
    let test = SelfTest::run(device()).unwrap();
    let limits = device().limits();
    assert_eq!(test.deviations.is_empty(), !limits.half_storage);
    let matrices = test.deviations.iter().filter(|(kernel, _)| kernel.ends_with("_matrix")).count();
    assert_eq!(matrices >= 2, limits.matrices.is_some(), "{test:?}");
    // A kernel that did nothing would differ by as much as its result.
    assert!(test.deviations.iter().all(|(_, deviation)| deviation.is_some_and(|times| times < 0.5)), "{test:?}");
}

#[test]
fn precisions_become_arithmetics() {
    let limits = device().limits();
    let exact = Chosen::of(device(), Some(Precision::Exact)).unwrap();
    assert_eq!((exact.precision, exact.arithmetic.element), (Precision::Exact, Element::F32));
    if limits.half_storage {
        let fast = Chosen::of(device(), Some(Precision::Fast)).unwrap();
        assert_eq!((fast.precision, fast.arithmetic.element), (Precision::Fast, Element::F16));
        assert_eq!((fast.arithmetic.linear, fast.arithmetic.attention), (limits.matrices, limits.matrices));
        assert!(fast.notes.is_empty(), "{:?}", fast.notes);
    }
    let best = Chosen::of(&Device::open(&DeviceOptions::default()).unwrap(), None).unwrap();
    assert_eq!(best.precision == Precision::Exact, limits.cpu || limits.matrices.is_none());
}
