//! Operations on device tensors, shared by stages.

mod arithmetic;
mod attention;
mod block;
mod cross_block;
mod feature_map;
mod linear;
pub mod measure;
mod nearest;
mod norm;
mod packing;
mod parameters;
mod pool;
mod q8;
mod rows;
pub mod scan;
pub mod sort;
mod tile;
mod uniform;

pub use arithmetic::{Arithmetic, Precision, Units};
pub use attention::{Attention, AttentionKernel, Heads, Part, Rotary};
pub use block::{Block, Ffn, Sequences};
pub use cross_block::CrossBlock;
pub use feature_map::FeatureMap;
pub(crate) use linear::NARROWEST;
pub use linear::{Activation, Epilogue, LaneTile, Lanes, Linear, LinearKernel, Weights};
pub use nearest::{Nearest, NearestKernel, NearestRows};
pub use norm::Norm;
pub use packing::pack_matrix;
pub use parameters::{HostParameter, ParameterLayout, ParameterSource, Parameters};
pub use pool::Pool;
pub use q8::Q8;
pub(crate) use rows::row_chunks;
pub use rows::{Columns, Rows, add, gather_rows, join_columns, place_columns, place_groups, quantize_rows};
pub use tile::{Tile, Tiles};
pub(crate) use uniform::{UNIFORM_TILE, divides_panels, terms_of};
