//! Per-device cache, keyed by driver and kernel hash.

use crate::{gpu::Device, kernels::MODULES};
use std::{
    hash::{DefaultHasher, Hash, Hasher},
    path::PathBuf,
};

pub(super) fn cache_file(device: &Device, kind: &str) -> Option<PathBuf> {
    let mut kernels = DefaultHasher::new();
    MODULES.hash(&mut kernels);
    let subgroup = device.limits().subgroup_size;
    let name = format!("{kind}/{}-{subgroup}-{:016x}.json", device.limits().identity, kernels.finish());
    device.cache_dir().map(|folder| folder.join(name))
}
