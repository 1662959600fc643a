//! Scene and colour tokens to Gaussians.

pub mod activate;
pub mod head;
