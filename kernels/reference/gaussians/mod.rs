//! Scene and colour tokens to Gaussians.

pub mod activate;
pub mod activate_backward;
pub mod head;
