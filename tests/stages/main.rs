//! Stages against goldens, and the references themselves.

mod align;
mod arena;
mod camera_estimates;
mod cameras;
mod depth;
mod depth_flops;
mod depth_reference;
mod depth_scene;
mod depth_units;
mod depth_weights;
mod edit;
mod flops;
mod forward;
mod gradients;
mod images;
mod lpips;
mod photos;
mod poses;
mod ray_cameras;
mod references;
mod refine;
mod scene_files;
mod scene_formats;
mod tokens;
mod trajectories;
mod weights;
