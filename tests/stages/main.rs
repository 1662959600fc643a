//! Stages against goldens, and the references themselves.

mod cameras;
mod images;
mod poses;
mod forward;
mod references;
mod scene_files;
mod weights;
