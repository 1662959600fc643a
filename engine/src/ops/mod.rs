//! Dispatches that several stages use. Each takes tensors and shapes and records; none owns device memory.

mod arithmetic;
mod attention;
mod attention_tile;
mod block;
mod cache;
mod chosen;
mod cross_block;
mod linear;
pub mod measure;
mod nearest;
mod norm;
mod parameters;
mod rows;
pub mod scan;
mod self_test;
pub mod sort;
mod tile;
mod tuning;

pub use arithmetic::{Arithmetic, Precision, Units};
pub use attention::{Attention, AttentionKernel, Heads, Part};
pub use attention_tile::AttentionTile;
pub use block::{Block, Sequences};
pub use cache::cache_folder;
pub use chosen::Chosen;
pub use cross_block::CrossBlock;
pub use linear::{Activation, Epilogue, Linear, LinearKernel};
pub use nearest::{Nearest, NearestKernel, NearestRows};
pub use norm::{Norm, NormRows};
pub use parameters::{ParameterLayout, pack_matrix};
pub(crate) use rows::row_chunks;
pub use rows::{add, gather_rows, join_columns, quantise_rows};
pub use self_test::SelfTest;
pub use tile::{LinearTile, NearestTile, Tiles};
pub use tuning::{Measured, Tuned, Tuning};
