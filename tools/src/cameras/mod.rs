mod colmap;
mod colmap_output;
mod find;
mod network;
mod paths;
mod place;
mod work;

pub use colmap::Searching;
pub use find::{COLMAP, EstimatedCameras, Finder, Finding, KnownCameras};
pub use paths::{CameraArgs, WorldPhoto, to_scene};
pub use place::{ModelOption, Place, path_from};
pub use work::lenses;
pub use zipsplat::types::Similarity;
