//! What crosses stages: images, cameras, Gaussians, and the files they come from.

mod camera;
mod file;
mod image;
mod ply;
pub mod poses;
pub mod preprocess;
pub mod resample;
mod scene;
mod trajectory;

pub use camera::{Camera, Intrinsics, Pose, matrix_from_quaternion, prior_encoding, quaternion_from_matrix};
pub use file::{Unfinished, write_atomic};
pub use image::{Image, contact_sheet};
pub use ply::{read_ply, write_ply};
pub use scene::Scene;
pub use trajectory::{Dolly, Ellipse, Orbit, Spline};
