//! What crosses stages: images, cameras, Gaussians, and the files they come from.

mod axes;
mod camera;
mod file;
mod gltf;
mod image;
mod left_out;
mod ply;
pub mod poses;
pub mod preprocess;
pub mod resample;
mod scene;
mod scene_file;
mod sh_rotation;
mod splat;
mod spz;
mod squares;
mod trajectory;

pub use camera::{Camera, Intrinsics, Pose, matrix_from_quaternion, prior_encoding, quaternion_from_matrix};
pub use file::{Unfinished, write_atomic};
pub use gltf::{read_gltf, write_gltf};
pub use image::{Image, contact_sheet};
pub(crate) use image::{MAX_DECODED_BYTES, MAX_SIDE};
pub use left_out::LeftOut;
pub use ply::{read_ply, read_ply_origin, read_points, write_ply, write_ply_with_origin, write_points};
pub use scene::Scene;
pub use scene_file::{SceneFormat, WriteOptions, read_scene, read_scene_unchecked, write_scene};
pub use splat::{read_splat, write_splat};
pub use spz::{read_spz, write_spz};
pub use squares::{square_count, squares};
pub use trajectory::{Dolly, Ellipse, Orbit, Spline};
