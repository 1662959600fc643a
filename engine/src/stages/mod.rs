//! The stages of a reconstruction; alphabetical order is the order of the data.

pub mod render;
