//! Cameras: of photos, from files or found by COLMAP, and along paths around a scene.

mod colmap;
mod find;
mod paths;
mod place;
mod work;

pub use find::{Finding, Found, Known};
pub use paths::{CameraArgs, origin};
pub use place::{Place, path_from};
