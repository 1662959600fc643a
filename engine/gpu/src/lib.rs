//! Vulkan compute: device, arena, recorder, runs and profiles.
//!
//! A [`Recorder`] turns typed kernel calls into a [`Plan`]: a command list with arena offsets. A
//! [`Run`] allocates the arena on a [`Device`] and executes the plan any number of times.
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
