//! Operations of several stages.

pub mod activation;
pub mod add;
pub mod attention;
pub mod gather_rows;
pub mod gelu;
pub mod im2col;
pub mod layer_norm;
pub mod linear;
pub mod place_columns;
pub mod quantize_rows;
pub mod split_heads;
