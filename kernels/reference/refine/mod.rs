pub mod adam;
pub mod anisotropy;
pub mod exposure;
