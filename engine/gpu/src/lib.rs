//! Vulkan compute.
//!
//! A [`Recorder`] turns typed kernel calls into a [`Plan`]: a command list with arena offsets. A
//! [`Run`] allocates the arena on a [`Device`] and executes the plan repeatedly.
#![allow(unsafe_code)]

mod device;
mod lock;
mod memory;
mod plan;
mod run;

pub use device::{
    Adopted, Device, DeviceInfo, DeviceOptions, Limits, Matrices, MatrixShape, QueueLock, Requirement, cache_dir,
    fast_requirements, list_devices, requirements,
};
pub use memory::{Arena, Claim, Element, Resident, ResidentLayout, Tensor};
pub use plan::{ArenaRow, Binding, GROUP_FOLD, Kernel, LocalSize, Module, Needs, Plan, Recorder};
pub use run::{ImagePlace, Point, Profile, ProfileRow, Progress, Run, StageTimes, Target};
use zipsplat_error::{Error, Result};
