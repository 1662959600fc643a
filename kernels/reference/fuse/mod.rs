//! Fusion of scene tokens.

pub mod cross_attention;
