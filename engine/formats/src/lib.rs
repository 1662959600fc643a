//! Images, cameras, 3D Gaussian scenes and their files.
//!
//! Failed reads and writes give [`Error::Io`], malformed files [`Error::Format`], invalid cameras
//! and images, scenes or photos whose fields disagree [`Error::Argument`].

mod axes;
mod bounded;
mod camera;
mod color_transform;
mod edit;
mod fault;
mod file;
mod folder;
mod format;
mod gltf;
mod image;
mod lens;
mod mask;
mod median;
mod ply;
mod points;
pub mod poses;
pub mod preprocess;
pub mod resample;
mod scalar;
mod scene;
mod scene_file;
mod sh_rotation;
mod similarity;
mod skipped_pass;
mod sog;
mod source;
mod splat;
mod spz;
mod tiles;
mod trajectory;
mod world;

pub use bounded::{Fitting, bounded, bounded_views};
pub use camera::{
    Camera, Intrinsics, Pose, matrix_from_quaternion, prior_encoding, quaternion_from_matrix, relative_encoding,
    unit_quaternion,
};
pub use color_transform::ColorTransform;
pub use edit::{Edit, EditReport, Edited};
pub use file::{Unfinished, open_file, remove_stale, write_atomic};
pub use folder::{PHOTO_EXTENSIONS, is_photo, natural_order};
pub use format::SaveOptions;
pub use image::{Image, MAX_DECODED_BYTES, MAX_SIDE, check_jpeg_end, contact_sheet, is_heic_start};
pub use lens::{CUT_VIEW_DEG, Distortion, Lens, LensView, MAX_VIEW_DEG};
pub use mask::{MASKED, MaskSource, Masks, named_after};
pub use median::median;
pub use ply::{
    PlyProperty, PointCloud, read_ply, read_ply_property, read_points, write_ply, write_ply_with, write_points,
};
pub use scene::{NEAR, SH_0, Scene, near};
pub use scene_file::{SceneFormat, decode_world, read_world};
pub use sh_rotation::sh_rotation;
pub use similarity::Similarity;
pub use skipped_pass::SkippedPass;
pub use spz::spz_coarsening;
pub use tiles::{tile_count, tiles};
pub use trajectory::{Dolly, Ellipse, Orbit, Spline, mean_up};
pub use world::{Origin, World};
use zipsplat_error::{Error, Result};
