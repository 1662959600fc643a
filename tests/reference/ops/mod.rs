//! Operations that several stages use.

pub mod activation;
pub mod attention;
pub mod layer_norm;
pub mod linear;
