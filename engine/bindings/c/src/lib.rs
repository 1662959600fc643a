//! The C ABI.
//! `tests/abi/header.rs` generates `engine/bindings/c/include/zipsplat.h` from these files, doc
//! comments included. They address C callers, so caller obligations are in plain text, not in `#
//! Safety` sections.
//!
//! Every entry point runs inside `status::guard`, which catches panics and stores the thread's
//! message. Enumerations and booleans arrive as plain integers and are checked.
#![allow(unsafe_code, non_camel_case_types, clippy::missing_safety_doc)]

mod capture;
mod context;
mod depth;
mod gradients;
mod model;
mod photo;
mod picture;
mod pointers;
mod reconstruct;
mod refine;
mod renderer;
mod scene;
mod status;
mod version;
mod vulkan;

const _: () = {
    const fn any_thread<T: Send + Sync>() {}
    any_thread::<zs_bytes>();
    any_thread::<zs_capture>();
    any_thread::<zs_context>();
    any_thread::<zs_depth_model>();
    any_thread::<zs_depths>();
    any_thread::<zs_model>();
    any_thread::<zs_photo>();
    any_thread::<zs_renderer>();
    any_thread::<zs_scene>();
};

pub use capture::*;
pub use context::*;
pub use depth::*;
pub use gradients::*;
pub use model::*;
pub use photo::*;
pub use picture::*;
pub use reconstruct::*;
pub use refine::*;
pub use renderer::*;
pub use scene::*;
pub use status::*;
pub use version::*;
pub use vulkan::*;
