//! Devices that are lost and drivers that refuse, at every point of what commands and contexts do.

mod commands;
mod contexts;
