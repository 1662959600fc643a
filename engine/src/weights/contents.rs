use std::collections::HashMap;

use super::tensor::{Stored, StoredDtype};
use super::{Architecture, DepthArchitecture};
use crate::types::preprocess::PATCH;

pub(super) const MAX_IMAGE_SIZE: u32 = 8192;

/// Added by distributed training and compilation.
const WRAPPERS: [&str; 2] = ["module", "_orig_mod"];

#[derive(Debug, Default)]
pub(super) struct Contents {
    pub tensors: HashMap<String, Stored>,
    pub architecture: Option<Architecture>,
    pub depth_architecture: Option<DepthArchitecture>,
    pub image_size: Option<u32>,
    pub conf: Conf,
}

/// Settings that shapes do not show.
#[derive(Clone, Debug, Default)]
pub(super) struct Conf {
    pub vit_name: Option<String>,
    pub out_layers: Option<Vec<usize>>,
    pub alt_start: Option<usize>,
    /// `usize::MAX` disables it.
    pub rope_start: Option<usize>,
    pub camera_heads: Option<usize>,
    pub gaussians_per_token: Option<usize>,
    pub sh_degree: Option<usize>,
}

pub(super) fn add(
    tensors: &mut HashMap<String, Stored>,
    name: &str,
    tensor: Result<Stored, String>,
) -> Result<(), String> {
    let tensor = tensor.map_err(|reason| format!("{name}: {reason}"))?;
    match tensors.insert(bare(name), tensor) {
        Some(_) => Err(format!("{name}: found twice, with and without `module.` or `_orig_mod.`")),
        None => Ok(()),
    }
}

/// Removes wrappers from a tensor's name.
pub(super) fn bare(name: &str) -> String {
    name.split('.').filter(|part| !WRAPPERS.contains(part)).collect::<Vec<_>>().join(".")
}

pub(super) fn is_image_size(side: u32) -> bool {
    (PATCH..=MAX_IMAGE_SIZE).contains(&side) && side.is_multiple_of(PATCH)
}

impl Contents {
    pub fn axis(&self, name: &str, axis: usize) -> Option<usize> {
        self.tensors.get(name)?.shape.get(axis).copied()
    }

    pub fn doubles(&self) -> usize {
        self.tensors.values().filter(|tensor| tensor.dtype == StoredDtype::F64).count()
    }
}
