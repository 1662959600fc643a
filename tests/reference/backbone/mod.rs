//! Images to tokens: a vision transformer that alternates attention within a view and across views.

pub mod block;
pub mod camera_encoder;
pub mod features;
pub mod patch_embed;
pub mod positions;
pub mod rope;
