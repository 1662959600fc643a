//! Procedural scenes: textured primitives along realistic camera paths, with exact depth and poses.
//! A seed gives the same bytes on any number of threads.
//!
//! Training on such data transfers to photos: LRM-Zero (Xie et al. 2024), MegaSynth (Jiang et al.
//! 2025).

mod builder;
mod bvh;
mod capture;
mod families;
mod folder;
mod height_field;
mod material;
mod noise;
mod path;
mod photos;
mod rng;
mod shape;
pub mod shards;
mod survey;
mod texture;
mod tone;
mod wide;
mod world;

pub use capture::{Capture, GoOn, Options, Setup, WidePhoto};
pub use families::Family;
pub use folder::{files, write_folder, write_wide};
pub use height_field::HeightField;
pub use path::PathKind;
pub use photos::{Crop, Photos};
pub use shape::{Primitive, Shape};
pub use survey::{LEAST_OVERLAP, WITNESSES};
pub use wide::{WideLens, WideModel};
pub use world::World;

/// Version of the generator's output.
pub const VERSION: u32 = 2;
