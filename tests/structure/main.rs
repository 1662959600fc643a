//! How the project is laid out: what mirrors what, who may use whom, and how long files are.

mod imports;
mod mirror;
mod sizes;
mod source;
