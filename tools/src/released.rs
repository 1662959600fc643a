//! Weights that have a name: what can be got, and what of it lies in the cache folder.

use crate::download::{Client, TAG};
use std::path::{Path, PathBuf};
use zipsplat::{Error, Result, tune::cache_folder};

/// Released weights.
pub struct Released {
    /// Name that `--weights` takes.
    pub name: &'static str,
    pub what: &'static str,
    pub licence: &'static str,
    /// The licence's meaning for a user.
    pub terms: &'static str,
    /// About how many bytes come over the network.
    pub bytes: u64,
    repository: &'static str,
    file: &'static str,
}

/// All that there are.
pub const RELEASED: [Released; 1] = [Released {
    name: "zipsplat",
    what: "ZipSplat on DA3-Giant, 1.4 G parameters, by the paper's authors",
    licence: "CC BY-NC",
    terms: "name the authors; no commercial use",
    bytes: 5_800_000_000,
    repository: "veichta/zipsplat",
    file: "zipsplat-da3g-252p.tar",
}];

/// The end of the names of cached weights, after the hash of the file that they were made from.
const CONVERTED: &str = "-f16.safetensors";

impl Released {
    /// The weights of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        RELEASED.iter().find(|released| released.name == name)
    }

    /// Their address at the hub.
    pub fn address(&self, client: &Client) -> String {
        client.address(self.repository, "main", self.file)
    }

    /// The command that gets them.
    pub fn command(&self) -> String {
        format!("zipsplat weights get {}", self.name)
    }

    /// A path beside which the loaded file and its conversion lie.
    pub fn base(&self, folder: &Path) -> PathBuf {
        folder.join(self.file)
    }

    /// The path of the conversion of a loaded file, which has its hash in its name.
    pub fn converted(&self, loaded: &Path) -> PathBuf {
        let stem = loaded.file_stem().unwrap_or_default().to_string_lossy();
        loaded.with_file_name(format!("{stem}{CONVERTED}"))
    }

    /// The conversions that are there, the newest first.
    pub fn cached(&self, folder: &Path) -> Vec<PathBuf> {
        self.tagged(folder, CONVERTED)
    }

    /// Files that were loaded and checked and are not converted, the newest first.
    pub fn loaded(&self, folder: &Path) -> Vec<PathBuf> {
        self.tagged(folder, &self.file[self.stem().len()..])
    }

    fn stem(&self) -> &'static str {
        self.file.split('.').next().unwrap_or(self.file)
    }

    /// Files called after these weights, a hash, and `ending`.
    fn tagged(&self, folder: &Path, ending: &str) -> Vec<PathBuf> {
        let tag = |name: &str| {
            let tag = name.strip_prefix(self.stem())?.strip_prefix('-')?.strip_suffix(ending)?;
            (tag.len() == TAG && tag.bytes().all(|byte| byte.is_ascii_hexdigit())).then_some(())
        };
        let entries = folder.read_dir().into_iter().flatten().flatten();
        let mut found: Vec<_> = (entries.filter(|entry| tag(&entry.file_name().to_string_lossy()).is_some()))
            .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
            .collect();
        found.sort();
        found.into_iter().rev().map(|(_, path)| path).collect()
    }
}

/// The folder of weights in the user's cache.
///
/// # Errors
/// [`Error::Argument`] where the environment names no such folder.
pub fn folder() -> Result<PathBuf> {
    let cache = cache_folder().map(|cache| cache.join("weights"));
    cache.ok_or_else(|| Error::argument("cache folder", "none", "ZIPSPLAT_CACHE, or HOME, in the environment"))
}

/// The file of weights that are named so; none, where that is no name.
///
/// # Errors
/// [`Error::Argument`] where they are not in the cache, with the command that gets them.
pub fn find(name: &str) -> Result<Option<PathBuf>> {
    let Some(released) = Released::named(name) else { return Ok(None) };
    let folder = folder()?;
    let expected = || {
        let command = released.command();
        Error::argument(
            format!("weights {name}"),
            format!("none in {}", folder.display()),
            format!("those that `{command}` gets (./{name} is a file of that name)"),
        )
    };
    released.cached(&folder).into_iter().next().map(Some).ok_or_else(expected)
}
