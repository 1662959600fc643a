//! Implements the C interface, which `zipsplat.h` documents; `tests/abi/header.rs` compares them.
//!
//! Entry points run inside `status::guard`, which catches panics and stores the thread's message.
//! Enumerations and booleans arrive as integers and are checked. "SAFETY: the caller's arguments"
//! means the header's rules: pointers are NULL or valid as documented, unwritten during the call.
#![allow(unsafe_code, non_camel_case_types)]
#![allow(missing_docs, clippy::missing_safety_doc, reason = "zipsplat.h documents exported names and obligations")]

#[macro_use]
mod pointers;
mod camera;
mod capture;
mod depth;
mod device;
mod edit;
mod features;
mod gradients;
mod image;
mod model;
mod progress;
mod reconstruct;
mod reconstruction;
mod refine;
mod renderer;
mod scene;
mod status;
mod version;
mod vulkan;

const _: () = {
    const fn any_thread<T: Send + Sync>() {}
    any_thread::<zs_blob>();
    any_thread::<zs_capture>();
    any_thread::<zs_device>();
    any_thread::<zs_depth_model>();
    any_thread::<zs_depth_result>();
    any_thread::<zs_model>();
    any_thread::<zs_image_buffer>();
    any_thread::<zs_reconstruction>();
    any_thread::<zs_renderer>();
    any_thread::<zs_scene>();
};

pub use camera::*;
pub use capture::*;
pub use depth::*;
pub use device::*;
pub use edit::*;
pub use features::*;
pub use gradients::*;
pub use image::*;
pub use model::*;
pub use pointers::Versioned;
pub use progress::*;
pub use reconstruct::*;
pub use reconstruction::*;
pub use refine::*;
pub use renderer::*;
pub use scene::*;
pub use status::*;
pub use version::*;
pub use vulkan::*;
