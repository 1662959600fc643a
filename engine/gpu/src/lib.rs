//! Vulkan compute as plans: device, arena, recorder, runs and their profile. This crate alone names Vulkan, and it knows no kernel.
//!
//! A [`Recorder`] turns calls of typed kernels into a [`Plan`]: a plain command list, with an offset in one arena for
//! every tensor. A [`Run`] allocates that arena on a [`Device`] and executes the plan as often as wanted.
#![allow(unsafe_code)]

mod adopt;
mod arena;
mod barrier;
mod bfloat16;
mod bound;
mod commands;
mod copy;
mod descriptors;
mod device;
mod element;
mod failure;
mod features;
mod flight;
mod instance;
mod kernel;
mod layout;
mod limits;
mod lock;
mod lost;
mod memory;
mod pipelines;
mod plan;
mod probe;
mod profile;
mod queue;
mod recorder;
mod run;
mod schedule;
mod tensor;
mod times;
mod twins;

pub use adopt::{Adopted, QueueLock, Requirement, fast_requirements, requirements};
pub use arena::{Arena, Claim};
pub use device::{Device, DeviceOptions};
pub use element::Element;
pub use kernel::{Binding, Kernel, LocalSize, Module, Needs};
pub use limits::{Limits, Matrices, MatrixShape};
pub use memory::{Resident, ResidentLayout};
pub use plan::{ArenaRow, Plan};
pub use probe::{DeviceInfo, list_devices};
pub use profile::{Profile, ProfileRow};
pub use recorder::{GROUP_FOLD, Recorder};
pub use run::{ImagePlace, Point, Progress, Run, Target};
pub use tensor::Tensor;
pub use times::StageTimes;
use zipsplat_error::{Error, Result};
