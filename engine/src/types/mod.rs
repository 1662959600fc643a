//! What crosses stages: images, cameras, Gaussians, and the files they come from.
