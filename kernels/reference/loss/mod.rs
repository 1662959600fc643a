//! Losses of pictures.

pub mod gradient;
