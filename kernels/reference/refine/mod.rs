pub mod adam;
pub mod anisotropy;
pub mod dropout;
pub mod exposure;
