//! ZipSplat on Vulkan: photos without poses to a compact 3D Gaussian scene in one forward pass.
//!
//! ```no_run
//! use std::ops::ControlFlow::Continue;
//! use zipsplat::{Camera, Device, Image, Model, Renderer, gpu::DeviceOptions, reconstruct::Request};
//! use zipsplat::{stages::render::RenderRequest, types::Intrinsics, types::Pose, types::preprocess::fit, weights::Checkpoint};
//!
//! # fn main() -> zipsplat::Result<()> {
//! let device = Device::open(&DeviceOptions::default())?;
//! let model = Model::load(&device, &Checkpoint::open("weights.safetensors", None)?, |_| Continue(()))?;
//! let photos = [fit(&Image::open("a.jpg")?, 252, 252)?.image, fit(&Image::open("b.jpg")?, 252, 252)?.image];
//! let made = model.reconstruct(&photos, &Request::default(), |_| Continue(()))?;
//! zipsplat::types::write_scene("scene.ply", &made.scene()?, &Default::default())?;
//!
//! let mut renderer = Renderer::new(&device);
//! renderer.show(&made.gaussians)?; // they never left the device
//! let frames = renderer.render_loaded(&[camera], &RenderRequest::default())?;
//! # let _ = frames;
//! # Ok(())
//! # }
//! ```
//!
//! Crates below: [`types`] (`zipsplat-formats`, without GPU) and [`gpu`] (`zipsplat-gpu`, all
//! Vulkan, no kernels). Modules depend only on earlier ones: `ops` <- `tune` <- `stages` <-
//! `weights` <- `perceptual` <- `cameras` <- `reconstruct` <- `depth` <- `refine` <- `ffi`. `ops`
//! records dispatches. `tune` selects its kernels as an [`ops::Arithmetic`], by self-tests and
//! timings. `stages` declare parameters, which `weights` reads.

pub mod cameras;
pub mod depth;
pub mod ffi;
pub mod ops;
pub mod perceptual;
mod random;
pub mod reconstruct;
pub mod refine;
pub mod stages;
pub mod tune;
pub mod weights;

/// Typed kernels, generated from `kernels/`.
pub mod kernels {
    #![allow(clippy::too_many_arguments, missing_docs)]
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));

    const _: () = assert!(limits::GROUP_FOLD == crate::gpu::GROUP_FOLD);
}

pub use gpu::Device;
pub use reconstruct::Model;
pub use stages::render::Renderer;
pub use types::{Camera, Image, Scene};
pub use zipsplat_error::{Error, Result};
#[doc(inline)]
pub use zipsplat_formats as types;
#[doc(inline)]
pub use zipsplat_gpu as gpu;
