//! Rendering by the rules of gsplat 1.5.3.

pub mod backward;
pub mod normals;
pub mod pack;
pub mod project;
pub mod rasterize;
pub mod sh;
