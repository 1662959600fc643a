//! Reconstructs compact scenes of 3D Gaussians from photos in one forward pass, on Vulkan; also
//! refines and renders them.
//!
//! ```no_run
//! use std::ops::ControlFlow::Continue;
//! use zipsplat::{Camera, Device, Image, Model, Ratio};
//! use zipsplat::{ReconstructOptions, RenderOptions, Renderer};
//!
//! # fn main() -> zipsplat::Result<()> {
//! let device = Device::open_default()?;
//! let model = Model::load(&device, "builtin")?;
//! let photos = Image::open_folder("photos/")?;
//! let options = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..Default::default() };
//! let result = model.reconstruct(&photos, &options, |_| Continue(()))?;
//! result.to_scene()?.save("scene.ply")?;
//!
//! let mut renderer = Renderer::new(&device);
//! renderer.set_scene(&result)?; // no readback
//! let camera = Camera::from_hfov_deg(640, 480, 60.0);
//! renderer.render(&[camera], &RenderOptions::default())?[0].save_png("view.png")?;
//! # Ok(())
//! # }
//! ```
//!
//! The public interface is at the root and in [`vulkan`], [`paths`], [`grad`] and [`types`]. Hidden
//! modules serve the project's own tools and follow no semantic versioning.
//!
//! The crate builds on [`types`] (`zipsplat-formats`, without GPU), [`gpu`] (`zipsplat-gpu`, the
//! only crate that names Vulkan) and [`random`]. Its modules depend only on those before them:
//! `ops`, `tune`, `stages`, `weights`, `perceptual`, `features`, `cameras`, `reconstruct`, `depth`,
//! `refine`.

pub mod cameras;
pub mod depth;
pub mod features;
#[doc(hidden)]
pub mod ops;
#[doc(hidden)]
pub mod perceptual;
pub mod reconstruct;
pub mod refine;
#[doc(hidden)]
pub mod stages;
#[doc(hidden)]
pub mod tune;
#[doc(hidden)]
pub mod weights;

/// Interoperation with an application's Vulkan device.
pub mod vulkan {
    pub use crate::gpu::{Adopted, ImagePlace, Point, QueueLock, Requirement, Target, requirements};
    pub use crate::stages::render::PixelLayout;
}

/// Camera paths.
pub mod paths {
    pub use crate::types::{Dolly, Ellipse, Orbit, Spline, mean_up};
}

/// Gradients of rendering.
pub mod grad {
    pub use crate::stages::render::{Differentiator, HostGradients, Wanted};
}

/// Typed kernels, generated from `kernels/`.
#[doc(hidden)]
pub mod kernels {
    #![allow(clippy::too_many_arguments, missing_docs)]
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));

    // Recorder and kernels must fold long dispatches alike.
    const _: () = assert!(limits::GROUP_FOLD == crate::gpu::GROUP_FOLD);
}

pub use depth::{DepthMap, DepthModel, DepthOptions, DepthPrediction};
pub use gpu::{Device, DeviceInfo, DeviceOptions, Progress, list_devices};
pub use ops::Precision;
pub use reconstruct::{Model, ModelOptions, Ratio, ReconstructOptions, Reconstruction, SceneFrame, TokenSelection};
pub use refine::{Photos, RefineLength, RefineOptions, RefineResult, refine_scene};
pub use stages::render::{Depth, RenderOptions, RenderOutput, Renderer};
pub use types::{Camera, Edit, EditReport, Edited, Image, Intrinsics, Pose, SaveOptions, Scene, poses::Capture};
pub use zipsplat_error::{Error, Result};
#[doc(inline)]
pub use zipsplat_formats as types;
#[doc(hidden)]
pub use zipsplat_gpu as gpu;
#[doc(hidden)]
pub use zipsplat_random as random;
