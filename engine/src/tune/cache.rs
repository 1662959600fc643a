//! Where what was found of a device is kept in the user's cache: another driver, or other kernels, and it is found anew.

use crate::{gpu::Device, kernels::MODULES};
use std::{
    hash::{DefaultHasher, Hash, Hasher},
    path::PathBuf,
};

/// The folder in which this program may keep what it can find or get again: `ZIPSPLAT_CACHE`, or `zipsplat` in the user's
/// cache; none, where the environment names neither.
pub fn cache_folder() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let folder = |name: &str, below: &str| set(name).map(|value| PathBuf::from(value).join(below));
    folder("ZIPSPLAT_CACHE", "")
        .or_else(|| folder("XDG_CACHE_HOME", "zipsplat"))
        .or_else(|| folder("LOCALAPPDATA", "zipsplat"))
        .or_else(|| folder("HOME", ".cache/zipsplat"))
}

/// The file of a `kind` of findings about a device.
pub(super) fn cache_file(device: &Device, kind: &str) -> Option<PathBuf> {
    let cache = cache_folder()?;
    let mut kernels = DefaultHasher::new();
    MODULES.hash(&mut kernels);
    let subgroup = device.limits().subgroup_size;
    Some(cache.join(format!("{kind}/{}-{subgroup}-{:016x}.json", device.limits().identity, kernels.finish())))
}
