//! The only place that names Vulkan: device, arena, kernels, recorder, runs and their profile.
//!
//! A [`Recorder`] turns calls of typed kernels into a [`Plan`]: a plain command list, with an offset in one arena for
//! every tensor. A [`Run`] allocates that arena on a [`Device`] and executes the plan as often as wanted.
#![allow(unsafe_code)]

mod adopt;
mod arena;
mod bfloat16;
mod commands;
mod descriptors;
mod device;
mod flight;
mod instance;
mod kernel;
mod layout;
mod limits;
mod lost;
mod memory;
mod pipelines;
mod plan;
mod profile;
mod queue;
mod recorder;
mod run;
mod schedule;
mod twins;

pub use adopt::{Adopted, QueueLock, Requirement, fast_requirements, requirements};
pub use arena::{Arena, Claim};
pub use device::{Device, DeviceOptions};
pub use instance::{DeviceInfo, list_devices};
pub use kernel::{Binding, Element, Kernel, LocalSize, Module, Needs};
pub use limits::{Limits, Matrices, MatrixShape};
pub use memory::{Resident, ResidentLayout};
pub use plan::{ArenaRow, Plan, Tensor};
pub use profile::{Profile, ProfileRow};
pub use recorder::{GROUP_FOLD, Recorder};
pub use run::{ImagePlace, Point, Progress, Run, StageTimes, Target};
use zipsplat_error::{Error, Result};
