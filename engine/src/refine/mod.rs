//! Refinement: tokens, Gaussians and cameras made to fit the photos.

mod adam;

pub use adam::{Adam, Space, record_adam};
