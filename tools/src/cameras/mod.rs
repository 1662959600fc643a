//! Cameras: of photos, from files or found by COLMAP, and along paths around a scene.

mod colmap;
mod find;
mod paths;

pub use find::{Finding, Found, Known, Place, path_from};
pub use paths::{CameraArgs, origin};
