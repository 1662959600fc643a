//! Scene and colour tokens to Gaussians.

pub mod head;
