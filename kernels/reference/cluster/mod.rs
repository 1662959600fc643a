//! Token clustering: k-means, then the token nearest to each centroid.

pub mod halves;
pub mod kmeans;
pub mod mean;
pub mod nearest;
pub mod origin;
pub mod panels;
