//! The parts that tests share: references in f64, goldens, and comparison.
//!
//! - [`architectures`] are the networks that the goldens were made with.
//! - [`faults`] are devices that are lost and drivers that refuse.
//! - [`golden`] opens the dumps of the PyTorch implementation.
//! - [`mod@device`] is the device that tests run on.
//! - [`compare`] holds every tolerance and says readably where two arrays or pictures differ.
//! - [`networks`] are models and pictures of the goldens.
//! - [`photos`] are photos as cameras write them.
//! - [`processes`] are tests that run in processes of their own.
//! - [`mod@reference`] computes the same things again in f64, slowly and by other algorithms than the kernels.
//! - [`mod@random`] are numbers that are the same on every machine.
//! - [`scenes`] are Gaussians and cameras as the engine takes them.

pub mod architectures;
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
