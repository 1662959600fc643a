pub mod depth;
pub mod gradient;
pub mod targets;
