//! Stages against goldens.

mod cameras;
mod images;
mod poses;
mod scene_files;
