//! Stages against goldens, and the references themselves.

mod cameras;
mod forward;
mod images;
mod poses;
mod references;
mod scene_files;
mod trajectories;
mod weights;
