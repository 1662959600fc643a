//! Shared parts of the tests.

#![allow(missing_docs)]

pub mod architectures;
pub mod catalog;
pub mod command;
pub mod compare;
pub mod device;
pub mod faults;
pub mod files;
pub mod golden;
pub mod networks;
pub mod photos;
pub mod pickles;
pub mod prelude;
pub mod processes;
pub mod random;
pub mod scenes;

pub use zipsplat_reference as reference;
