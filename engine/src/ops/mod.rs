//! Dispatches that several stages use.

pub mod scan;
pub mod sort;
