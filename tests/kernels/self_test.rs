use zipsplat::gpu::Matrices;
use zipsplat::tune::{KernelChoice, SelfTest};
use zipsplat_tests::prelude::*;

#[test]
fn every_kernel_of_this_device_passes() {
    let test = SelfTest::run(device()).unwrap();
    let limits = device().limits();
    assert_eq!(test.deviations.is_empty(), !limits.half_storage);
    let matrices = test.deviations.iter().filter(|(kernel, _)| kernel.contains("_matrix_")).count();
    assert_eq!(matrices > 0, limits.matrices != Matrices::default(), "{test:?}");
    // A kernel that writes nothing deviates by its whole result.
    assert!(test.deviations.values().all(|deviation| deviation.is_some_and(|times| times < 0.5)), "{test:?}");
}

#[test]
fn precisions_become_arithmetics() {
    let limits = device().limits();
    let exact = KernelChoice::of(device(), Some(Precision::Fp32)).unwrap();
    assert_eq!((exact.precision, exact.arithmetic), (Precision::Fp32, Arithmetic::EXACT));
    for precision in Precision::ALL {
        match (KernelChoice::of(device(), Some(precision)), Arithmetic::of(precision, limits)) {
            (Ok(chosen), Some(arithmetic)) => {
                assert_eq!((chosen.precision, chosen.arithmetic), (precision, arithmetic));
                assert!(chosen.warnings.is_empty(), "{:?}", chosen.warnings);
            }
            (Err(error), None) => assert!(error.to_string().contains(precision.name()), "{error}"),
            (chosen, arithmetic) => panic!("{precision:?}: {chosen:?}, expected {arithmetic:?}"),
        }
    }
    let best = KernelChoice::of(&Device::open(&DeviceOptions::default()).unwrap(), None).unwrap();
    assert_eq!(best.precision == Precision::Fp32, limits.cpu || limits.matrices.f16.is_none());
}
