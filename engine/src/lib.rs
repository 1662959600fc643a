//! ZipSplat on Vulkan: photos without poses to a compact 3D Gaussian scene in one forward pass.
//!
//! ```no_run
//! use std::ops::ControlFlow::Continue;
//! use zipsplat::types::{Intrinsics, Pose, preprocess::fit};
//! use zipsplat::{Camera, Device, Image, Model, Renderer, gpu::DeviceOptions};
//! use zipsplat::{reconstruct::ReconstructOptions, stages::render::RenderOptions, weights::Checkpoint};
//!
//! # fn main() -> zipsplat::Result<()> {
//! let device = Device::open(&DeviceOptions::default())?;
//! let checkpoint = Checkpoint::open("weights.safetensors", None)?;
//! let model = Model::from_checkpoint(&device, &checkpoint, |_| Continue(()))?;
//! let [a, b] = [Image::open("a.jpg")?, Image::open("b.jpg")?];
//! let photos = [fit(&a, 252, 252)?.image, fit(&b, 252, 252)?.image];
//! let made = model.reconstruct_views(&photos, &ReconstructOptions::default(), |_| Continue(()))?;
//! made.scene()?.save("scene.ply")?;
//!
//! let mut renderer = Renderer::new(&device);
//! renderer.show(&made.gaussians)?; // already on the device
//! let intrinsics = Intrinsics::from_fov(252, 252, 1.0, 1.0);
//! let camera = Camera { intrinsics, pose: Pose::IDENTITY };
//! let frames = renderer.render(&[camera], &RenderOptions::default())?;
//! # let _ = frames;
//! # Ok(())
//! # }
//! ```
//!
//! Crates below: [`types`] (`zipsplat-formats`, without GPU), [`gpu`] (`zipsplat-gpu`, all
//! Vulkan, no kernels) and [`random`]. Modules depend only on earlier ones: `ops` <- `tune` <-
//! `stages` <- `weights` <- `perceptual` <- `cameras` <- `reconstruct` <- `depth` <- `refine`.

pub mod cameras;
pub mod depth;
pub mod ops;
pub mod perceptual;
pub mod reconstruct;
pub mod refine;
pub mod stages;
pub mod tune;
pub mod weights;

/// Typed kernels, generated from `kernels/`.
pub mod kernels {
    #![allow(clippy::too_many_arguments, missing_docs)]
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));

    // Recorder and kernels must fold long dispatches alike.
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
#[doc(inline)]
pub use zipsplat_random as random;
