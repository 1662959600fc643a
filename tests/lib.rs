//! What tests share: references in f64, goldens, and comparison.

pub mod architectures;
