//! Layout of the project: mirrored names, dependencies and file sizes.

mod imports;
mod mirror;
mod sizes;
mod source;
