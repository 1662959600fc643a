//! Vision transformer that alternates attention within and across views.

pub mod average_halves;
pub mod block;
pub mod camera_encoder;
pub mod camera_token;
pub mod features;
pub mod patchify;
pub mod positions;
pub mod reference_view;
pub mod rope;
pub mod tokens;
