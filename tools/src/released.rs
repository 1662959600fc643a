use crate::download::{Client, TAG};
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    gpu::cache_dir,
    weights::{DepthCheckpoint, DepthHeads},
};

pub struct Released {
    pub name: &'static str,
    pub what: &'static str,
    /// Name and terms.
    pub license: (&'static str, &'static str),
    /// Approximate download size.
    pub bytes: u64,
    pub kind: Kind,
    repository: &'static str,
    file: &'static str,
    /// File name in the cache, without the hash.
    kept_as: &'static str,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// ZipSplat, converted to f16 safetensors.
    Tokens,
    /// Depth Anything 3 or VGGT, unconverted.
    Depth,
}

pub const RELEASED: [Released; 8] = [
    Released {
        name: "zipsplat",
        what: "ZipSplat on DA3-Giant, 1.4 G parameters, by the paper's authors",
        license: ("CC BY-NC", NO_COMMERCE),
        bytes: 5_800_000_000,
        kind: Kind::Tokens,
        repository: "veichta/zipsplat",
        file: "zipsplat-da3g-252p.tar",
        kept_as: "zipsplat-da3g-252p.tar",
    },
    Released {
        what: "Depth Anything 3, 34 M parameters",
        license: APACHE,
        bytes: 140_000_000,
        ..of_depth("da3-small", "depth-anything/DA3-SMALL", "da3-small.safetensors")
    },
    Released {
        what: "Depth Anything 3, 135 M parameters",
        license: APACHE,
        bytes: 540_000_000,
        ..of_depth("da3-base", "depth-anything/DA3-BASE", "da3-base.safetensors")
    },
    Released {
        what: "Depth Anything 3, 411 M parameters, trained anew as 1.1",
        bytes: 1_640_000_000,
        ..of_depth("da3-large", "depth-anything/DA3-LARGE-1.1", "da3-large-1.1.safetensors")
    },
    Released {
        what: "Depth Anything 3 with a head for Gaussians, 1.4 G parameters, trained anew as 1.1",
        bytes: 5_420_000_000,
        ..of_depth("da3-giant", "depth-anything/DA3-GIANT-1.1", "da3-giant-1.1.safetensors")
    },
    Released {
        what: "Depth Anything 3 of each photo by itself, 334 M parameters",
        license: APACHE,
        bytes: 1_340_000_000,
        ..of_depth("da3mono-large", "depth-anything/DA3MONO-LARGE", "da3mono-large.safetensors")
    },
    Released {
        what: "Depth Anything 3 of each photo by itself, in meters, 334 M parameters",
        license: APACHE,
        bytes: 1_340_000_000,
        ..of_depth("da3metric-large", "depth-anything/DA3METRIC-LARGE", "da3metric-large.safetensors")
    },
    Released {
        what: "VGGT, 1.3 G parameters, of which depth and cameras need 1.16 G",
        bytes: 5_030_000_000,
        ..of_depth("vggt-1b", "facebook/VGGT-1B", "vggt-1b.safetensors")
    },
];

const APACHE: (&str, &str) = ("Apache-2.0", "any use; keep the notices");
const NO_COMMERCE: &str = "name the authors; no commercial use";

/// Takes the stricter of two licenses.
const fn of_depth(name: &'static str, repository: &'static str, kept_as: &'static str) -> Released {
    Released {
        name,
        what: "",
        license: ("CC BY-NC 4.0", NO_COMMERCE),
        bytes: 0,
        kind: Kind::Depth,
        repository,
        file: "model.safetensors",
        kept_as,
    }
}

/// Suffix after the source's hash.
const CONVERTED: &str = "-f16.safetensors";

impl Released {
    pub fn named(name: &str) -> Option<&'static Self> {
        RELEASED.iter().find(|released| released.name == name)
    }

    pub fn address(&self, client: &Client) -> String {
        client.address(self.repository, "main", self.file)
    }

    pub fn command(&self) -> String {
        format!("zipsplat weights get {}", self.name)
    }

    pub fn base(&self, folder: &Path) -> PathBuf {
        folder.join(self.kept_as)
    }

    /// The file itself if unconverted.
    pub fn converted(&self, loaded: &Path) -> PathBuf {
        let stem = loaded.file_stem().unwrap_or_default().to_string_lossy();
        match self.kind {
            Kind::Tokens => loaded.with_file_name(format!("{stem}{CONVERTED}")),
            Kind::Depth => loaded.to_owned(),
        }
    }

    /// Newest first.
    pub fn cached(&self, folder: &Path) -> Vec<PathBuf> {
        match self.kind {
            Kind::Tokens => self.tagged(folder, CONVERTED),
            Kind::Depth => self.loaded(folder),
        }
    }

    /// Verified, unconverted, newest first.
    pub fn loaded(&self, folder: &Path) -> Vec<PathBuf> {
        self.tagged(folder, &self.kept_as[self.stem().len()..])
    }

    fn stem(&self) -> &'static str {
        self.kept_as.rsplit_once('.').map_or(self.kept_as, |(stem, _)| stem)
    }

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

pub fn folder() -> Result<PathBuf> {
    let cache = cache_dir().map(|cache| cache.join("weights"));
    cache.ok_or_else(|| Error::argument("cache folder", "none", "ZIPSPLAT_CACHE, or HOME, in the environment"))
}

/// `None` for a file.
pub fn find(name: &str) -> Result<Option<PathBuf>> {
    let Some(released) = Released::named(name) else { return check_name(name).map(|()| None) };
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

fn check_name(name: &str) -> Result<()> {
    let is_bare = !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte));
    if !is_bare || Path::new(name).exists() {
        return Ok(());
    }
    let names: Vec<&str> = RELEASED.iter().map(|released| released.name).collect();
    let expected = format!("a file, builtin, seeded:NAME, or one of {}", names.join(", "));
    Err(Error::argument("weights", name, expected))
}

pub fn is_of_depth(text: &str) -> bool {
    Released::named(text).map_or_else(|| DepthCheckpoint::is_meant(text), |released| released.kind == Kind::Depth)
}

/// Opens a name, `seeded:NAME`, or a file.
pub fn open_depth(text: &str, heads: DepthHeads) -> Result<DepthCheckpoint> {
    opener(text)?(heads)
}

/// Opens a depth network with the Gaussian head, if there is one.
pub fn open_whole_depth(text: &str) -> Result<DepthCheckpoint> {
    DepthCheckpoint::whole(opener(text)?)
}

/// Opens a depth network with all of its heads.
pub fn open_complete_depth(text: &str) -> Result<DepthCheckpoint> {
    DepthCheckpoint::with_all(opener(text)?)
}

fn opener(text: &str) -> Result<impl Fn(DepthHeads) -> Result<DepthCheckpoint>> {
    if Released::named(text).is_some_and(|released| released.kind != Kind::Depth) {
        let names = RELEASED.iter().filter(|released| released.kind == Kind::Depth).map(|released| released.name);
        let expected = format!("those of a depth network: {}, or a file", names.collect::<Vec<_>>().join(", "));
        return Err(Error::argument("weights", format!("{text}, of ZipSplat"), expected));
    }
    let cached = find(text)?;
    Ok(move |heads| match &cached {
        Some(path) => DepthCheckpoint::open(path, heads),
        None => DepthCheckpoint::parse(text, heads),
    })
}
