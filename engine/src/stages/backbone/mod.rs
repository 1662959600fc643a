//! Backbones: pixels to tokens, by a vision transformer over all views.
//!
//! Sources: ZipSplat, section 3.1; Depth Anything 3; DINOv2; VGGT, Wang et al. 2025. A new backbone
//! needs `transformer::SpecialTokens` and a line in `Transformer::new`.

mod da3;
mod depth;
mod features;
mod positions;
mod tokens;
mod transformer;
mod vggt;

pub use da3::interpolate_positions;
pub use depth::DepthBackbone;
pub use positions::rotary_tables;
pub use tokens::TokenBackbone;
pub use vggt::interpolate_antialiased;

use crate::{
    ops::ParameterLayout,
    stages::{BackboneArchitecture, Family},
};
use transformer::Transformer;

impl Transformer {
    pub fn new(p: &mut ParameterLayout, a: &BackboneArchitecture) -> Self {
        match a.family {
            Family::Da3 => da3::transformer(p, a),
            Family::Vggt => vggt::transformer(p, a),
        }
    }
}
