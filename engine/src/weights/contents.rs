//! The contents of a file.

use std::collections::HashMap;

use super::tensor::{Stored, StoredDtype};
use super::{Architecture, DepthArchitecture};
use crate::types::preprocess::PATCH;

/// A larger side of pictures in a file is a mistake.
pub(super) const MAX_PICTURE_SIDE: u32 = 8192;

/// Parts of a tensor's name that training adds: distribution over several devices, and compilation.
const WRAPPERS: [&str; 2] = ["module", "_orig_mod"];

/// A file's tensors, by their names without what training adds, and what else it says about its network.
#[derive(Debug, Default)]
pub(super) struct Contents {
    pub tensors: HashMap<String, Stored>,
    /// Stated whole, in the metadata of our own files.
    pub architecture: Option<Architecture>,
    /// The same of a network that finds depth.
    pub depth_architecture: Option<DepthArchitecture>,
    /// Stated in the metadata or the configuration: side of the pictures it was trained with, in pixels.
    pub picture_side: Option<u32>,
    /// Stated in part, in the training configuration of a PyTorch checkpoint.
    pub conf: Conf,
}

/// The entries of a training configuration that shapes do not show.
#[derive(Debug, Default)]
pub(super) struct Conf {
    pub vit_name: Option<String>,
    pub out_layers: Option<Vec<usize>>,
    pub alt_start: Option<usize>,
    /// `usize::MAX` for none.
    pub rope_start: Option<usize>,
    pub gaussians_per_token: Option<usize>,
    pub sh_degree: Option<usize>,
}

/// Adds a tensor under its name without what training adds; the reason, where that cannot be.
pub(super) fn add(
    tensors: &mut HashMap<String, Stored>,
    name: &str,
    tensor: Result<Stored, String>,
) -> Result<(), String> {
    let tensor = tensor.map_err(|reason| format!("{name}: {reason}"))?;
    let parts: Vec<&str> = name.split('.').filter(|part| !WRAPPERS.contains(part)).collect();
    match tensors.insert(parts.join("."), tensor) {
        Some(_) => Err(format!("{name}: found twice, with and without `module.` or `_orig_mod.`")),
        None => Ok(()),
    }
}

/// Whether pictures of this side, in pixels, can be what a network was trained with.
pub(super) fn is_picture_side(side: u32) -> bool {
    (PATCH..=MAX_PICTURE_SIDE).contains(&side) && side.is_multiple_of(PATCH)
}

impl Contents {
    /// How many of the tensors are f64.
    pub fn doubles(&self) -> usize {
        self.tensors.values().filter(|tensor| tensor.dtype == StoredDtype::F64).count()
    }
}
