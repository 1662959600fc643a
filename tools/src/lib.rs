//! What the command `zipsplat` is made of.

pub mod commands;
pub mod procedural;
