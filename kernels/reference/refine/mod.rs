//! Steps that make a scene fit its photos.

pub mod adam;
