//! Per-device cache, keyed by driver and kernel hash.

use crate::{gpu::Device, kernels::MODULES};
use std::{
    hash::{DefaultHasher, Hash, Hasher},
    path::PathBuf,
};

/// Returns the cache folder: `ZIPSPLAT_CACHE`, or `zipsplat` in the user's cache.
pub fn cache_folder() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let folder = |name: &str, below: &str| set(name).map(|value| PathBuf::from(value).join(below));
    folder("ZIPSPLAT_CACHE", "")
        .or_else(|| folder("XDG_CACHE_HOME", "zipsplat"))
        .or_else(|| folder("LOCALAPPDATA", "zipsplat"))
        .or_else(|| folder("HOME", ".cache/zipsplat"))
}

pub(super) fn cache_file(device: &Device, kind: &str) -> Option<PathBuf> {
    let cache = cache_folder()?;
    let mut kernels = DefaultHasher::new();
    MODULES.hash(&mut kernels);
    let subgroup = device.limits().subgroup_size;
    Some(cache.join(format!("{kind}/{}-{subgroup}-{:016x}.json", device.limits().identity, kernels.finish())))
}
