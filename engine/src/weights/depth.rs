use std::ops::{ControlFlow, Deref};
use std::path::Path;

use super::contents::Contents;
use super::save::save;
use super::source::Bytes;
use super::values::{Values, contents};
use super::{DEPTH_MODELS, DepthArchitecture, Dtype, Ffn, safetensors, torch};
use crate::{Error, Result, stages::MAX_DEPTH};

const BACKBONE: &str = "model.backbone.pretrained";
const AGGREGATOR: &str = "aggregator.";
const GAUSSIANS: &str = "model.gs_head.";
const POINTS: &str = "point_head.";
/// The multi-view network of DA3NESTED, beside a metric one.
const NESTED: &str = "model.da3.";

/// Optional heads of a depth network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DepthHeads {
    /// Gaussians per pixel, of Depth Anything 3's da3-giant.
    pub gaussians: bool,
    /// World points per pixel, of VGGT.
    pub points: bool,
}

/// A [`DepthArchitecture`] with its tensors.
#[derive(Debug)]
pub struct DepthCheckpoint {
    architecture: DepthArchitecture,
    values: Values,
    /// Heads of the file.
    heads: DepthHeads,
}

impl Deref for DepthCheckpoint {
    type Target = Values;

    fn deref(&self) -> &Values {
        &self.values
    }
}

impl DepthCheckpoint {
    /// Whether [`DepthCheckpoint::parse`] would find a depth network.
    pub fn is_meant(text: &str) -> bool {
        match text.strip_prefix("seeded:") {
            Some(name) => DEPTH_MODELS.contains(&name),
            None => names(Path::new(text)).is_ok_and(|names| {
                let known = |name: &String| [BACKBONE, AGGREGATOR, NESTED].iter().any(|start| name.starts_with(start));
                names.iter().any(known)
            }),
        }
    }

    /// Opens with the Gaussian head, if any.
    pub fn whole(open: impl Fn(DepthHeads) -> Result<Self>) -> Result<Self> {
        Self::with_all(|heads| open(DepthHeads { points: false, ..heads }))
    }

    /// Opens with all its heads.
    pub fn with_all(open: impl Fn(DepthHeads) -> Result<Self>) -> Result<Self> {
        let found = open(DepthHeads::default())?;
        if found.heads == DepthHeads::default() { Ok(found) } else { open(found.heads) }
    }

    /// Opens `seeded:NAME` or a path.
    pub fn parse(text: &str, heads: DepthHeads) -> Result<Self> {
        match text.strip_prefix("seeded:") {
            Some(name) => {
                let known = DepthArchitecture::named(name)?;
                let all = DepthHeads { gaussians: known.gaussians, points: known.points };
                Ok(Self { heads: all, ..Self::seeded(with_heads(known, heads)?, name)? })
            }
            None => Self::open(text, heads),
        }
    }

    /// Opens a released `model.safetensors` or `model.pt`, or a saved file, with `heads`. Nested
    /// networks give the multi-view one.
    ///
    /// # Errors
    /// As [`Checkpoint::open`](super::Checkpoint::open); [`Error::Argument`] for a network without
    /// such a head.
    pub fn open(path: impl AsRef<Path>, heads: DepthHeads) -> Result<Self> {
        let path = path.as_ref();
        let (file, contents) = opened(path)?;
        let known = match &contents.depth_architecture {
            Some(stated) => stated.clone(),
            None => inferred(&contents, path)?,
        };
        let architecture = with_heads(known, heads)?;
        Self::of(path, file, contents, architecture)
    }

    pub fn open_architecture(path: impl AsRef<Path>, architecture: DepthArchitecture) -> Result<Self> {
        let path = path.as_ref();
        let (file, contents) = opened(path)?;
        Self::of(path, file, contents, architecture)
    }

    pub fn seeded(architecture: DepthArchitecture, key: &str) -> Result<Self> {
        architecture.validate()?;
        let provenance = format!("seeded:{key}");
        let values = Values::seeded(&architecture.name, architecture.parameters(), key, provenance);
        let heads = DepthHeads { gaussians: architecture.gaussians, points: architecture.points };
        Ok(Self { heads, architecture, values })
    }

    fn of(path: &Path, file: Bytes, mut contents: Contents, architecture: DepthArchitecture) -> Result<Self> {
        architecture.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
        let parameters = architecture.parameters();
        let has = |head: &str| contents.tensors.keys().any(|name| name.starts_with(head));
        let heads = DepthHeads { gaussians: has(GAUSSIANS), points: has(POINTS) };
        let wanted = |name: &str| parameters.iter().any(|(other, _)| other == name);
        contents.tensors.retain(|name, _| wanted(name) || !is_unused(name));
        let values = Values::in_file(path, file, &architecture.name, parameters, contents)?;
        Ok(Self { architecture, values, heads })
    }

    pub fn architecture(&self) -> &DepthArchitecture {
        &self.architecture
    }

    /// Writes safetensors; 8-bit weights load as f32.
    pub fn save_with(
        &self,
        path: impl AsRef<Path>,
        dtype: Dtype,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<()> {
        let stated = [(safetensors::DEPTH_ARCHITECTURE_KEY, serde_json::to_string(&self.architecture))];
        save(self, stated, path.as_ref(), dtype, progress)
    }
}

fn names(path: &Path) -> Result<Vec<String>> {
    let file = Bytes::open(path)?;
    if torch::is_archive(&file) {
        return torch::names(path, &file);
    }
    Ok(safetensors::contents(path, &file)?.tensors.into_keys().collect())
}

fn opened(path: &Path) -> Result<(Bytes, Contents)> {
    let file = Bytes::open(path)?;
    let mut found = contents(path, &file)?;
    if found.tensors.keys().any(|name| name.starts_with(NESTED)) {
        let all = std::mem::take(&mut found.tensors).into_iter();
        let own = all.filter_map(|(name, tensor)| Some((format!("model.{}", name.strip_prefix(NESTED)?), tensor)));
        found.tensors = own.collect();
    }
    Ok((file, found))
}

fn with_heads(known: DepthArchitecture, DepthHeads { gaussians, points }: DepthHeads) -> Result<DepthArchitecture> {
    if gaussians && !known.gaussians {
        return Err(Error::argument(
            "network for Gaussians",
            &known.name,
            "da3-giant, which alone has a head for them",
        ));
    }
    if points && known.camera_head.is_none() {
        return Err(Error::argument("network for points", &known.name, "VGGT, which alone has a head for them"));
    }
    Ok(DepthArchitecture { gaussians, points, ..known })
}

fn is_unused(name: &str) -> bool {
    let tails = [
        GAUSSIANS,
        "model.head.scratch.output_conv1_aux.",
        "model.head.scratch.output_conv2_aux.",
        "aggregator.patch_embed.mask_token",
        POINTS,
        "track_head.",
    ];
    tails.iter().any(|tail| name.starts_with(tail))
}

fn inferred(contents: &Contents, path: &Path) -> Result<DepthArchitecture> {
    if contents.tensors.keys().any(|name| name.starts_with(AGGREGATOR)) {
        return DepthArchitecture::named("vggt-1b");
    }
    let block = |i: usize, part: &str| format!("{BACKBONE}.blocks.{i}.{part}");
    let width = contents.axis(&format!("{BACKBONE}.norm.weight"), 0);
    let depth = (0..MAX_DEPTH).take_while(|&i| contents.axis(&block(i, "norm1.weight"), 0).is_some()).count();
    let multi_view = contents.axis(&format!("{BACKBONE}.camera_token"), 0).is_some();
    let gated = contents.axis(&block(0, "mlp.w3.weight"), 0).is_some();
    let mut fitting = Vec::new();
    for name in DEPTH_MODELS.into_iter().filter(|name| name.starts_with("da3")) {
        let known = DepthArchitecture::named(name)?;
        let b = &known.backbone;
        let same =
            (Some(b.width), b.depth, known.multi_view(), b.ffn == Ffn::SwiGlu) == (width, depth, multi_view, gated);
        fitting.extend(same.then_some(known));
    }
    let found = match width {
        Some(width) => format!("{}, of width {width} and {depth} blocks", path.display()),
        None => format!("{}, without {BACKBONE}", path.display()),
    };
    let expected = || Error::argument("depth network", found, format!("one of {}", DEPTH_MODELS.join(", ")));
    let names = fitting.iter().map(|known| known.name.as_str()).collect::<Vec<_>>().join(" or ");
    let first = fitting.into_iter().next().ok_or_else(expected)?;
    // Two networks share a layout.
    Ok(DepthArchitecture { name: names, ..first })
}
