//! Token selection by k-means or mutual nearest neighbors.

pub mod halves;
pub mod kmeans;
pub mod mean;
pub mod mutual;
pub mod nearest;
pub mod origin;
pub mod panels;
