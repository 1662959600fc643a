//! One file a command.

pub mod scene;
