//! Shared parts of the tests.
//!
//! - [`architectures`]: networks of the goldens.
//! - [`catalogue`]: the kernels' cases.
//! - [`faults`]: device loss and failing drivers.
//! - [`golden`]: dumps of the PyTorch implementation.
//! - [`mod@device`]: the tests' device.
//! - [`compare`]: tolerances and comparison of arrays and pictures.
//! - [`networks`]: models and input images of the goldens.
//! - [`photos`]: photos as cameras write them.
//! - [`processes`]: tests in child processes.
//! - [`mod@reference`]: slow f64 references by other algorithms than the kernels'.
//! - [`mod@random`]: reproducible random numbers.
//! - [`scenes`]: Gaussians and cameras.

pub mod architectures;
pub mod catalogue;
pub mod compare;
pub mod device;
pub mod faults;
pub mod golden;
pub mod networks;
pub mod photos;
pub mod processes;
pub mod random;
pub mod scenes;

pub use zipsplat_reference as reference;
