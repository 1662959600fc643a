//! Layout of the project.

mod imports;
mod mirror;
mod sizes;
mod source;
