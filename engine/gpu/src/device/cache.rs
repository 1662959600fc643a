use std::path::PathBuf;

/// Returns the default cache folder: `ZIPSPLAT_CACHE`, or `zipsplat` in the user's cache.
pub fn cache_dir() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let folder = |name: &str, below: &str| set(name).map(|value| PathBuf::from(value).join(below));
    folder("ZIPSPLAT_CACHE", "")
        .or_else(|| folder("XDG_CACHE_HOME", "zipsplat"))
        .or_else(|| folder("LOCALAPPDATA", "zipsplat"))
        .or_else(|| folder("HOME", ".cache/zipsplat"))
}
