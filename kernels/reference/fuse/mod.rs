//! Scene tokens gather what the layers know: cross-attention to every layer, self-attention among themselves.

pub mod cross_attention;
