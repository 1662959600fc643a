use std::{collections::BTreeMap, ops::ControlFlow, path::Path};

use super::checkpoint::matching;
use super::contents::Contents;
use super::source::{Bytes, Source};
use super::{DEPTH_MODELS, DepthArchitecture, Dtype, Ffn, Q8, safetensors};
use crate::{Error, Result, ops::ParameterSource, stages::MAX_DEPTH};

const BACKBONE: &str = "model.backbone.pretrained";
const GAUSSIANS: &str = "model.gs_head.";

/// Depth weights, read one tensor at a time.
#[derive(Debug)]
pub struct DepthCheckpoint {
    architecture: DepthArchitecture,
    parameters: Vec<(String, Vec<usize>)>,
    source: Source,
    provenance: String,
    of_gaussians: bool,
}

impl DepthCheckpoint {
    /// Whether a text for [`DepthCheckpoint::parse`] denotes a depth network.
    pub fn is_meant(text: &str) -> bool {
        match text.strip_prefix("seeded:") {
            Some(name) => DEPTH_MODELS.contains(&name),
            None => {
                let path = Path::new(text);
                let read = || safetensors::contents(path, &Bytes::open(path).ok()?).ok();
                read().is_some_and(|contents| contents.tensors.keys().any(|name| name.starts_with(BACKBONE)))
            }
        }
    }

    /// Opens with the Gaussian head, if there is one.
    pub fn whole(open: impl Fn(bool) -> Result<Self>) -> Result<Self> {
        let found = open(false)?;
        if found.of_gaussians { open(true) } else { Ok(found) }
    }

    /// Opens `seeded:NAME` or a path.
    pub fn parse(text: &str, gaussians: bool) -> Result<Self> {
        match text.strip_prefix("seeded:") {
            Some(name) => {
                let known = DepthArchitecture::named(name)?;
                let of_gaussians = known.gaussians;
                Ok(Self { of_gaussians, ..Self::seeded(with_or_without(known, gaussians)?, name)? })
            }
            None => Self::open(text, gaussians),
        }
    }

    /// Opens a released `model.safetensors` or a saved file, optionally with the Gaussian head.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Format`]; [`Error::Argument`] for an unknown network or without
    /// Gaussian head; [`Error::Weights`] lists missing, unexpected and misshapen tensors.
    pub fn open(path: impl AsRef<Path>, gaussians: bool) -> Result<Self> {
        let path = path.as_ref();
        let file = Bytes::open(path)?;
        let contents = safetensors::contents(path, &file)?;
        let known = match &contents.depth_architecture {
            Some(stated) => stated.clone(),
            None => Shapes(&contents).architecture(path)?,
        };
        let architecture = with_or_without(known, gaussians)?;
        Self::of(path, file, contents, architecture)
    }

    /// Opens a file with a known architecture.
    pub fn open_architecture(path: impl AsRef<Path>, architecture: DepthArchitecture) -> Result<Self> {
        let path = path.as_ref();
        let file = Bytes::open(path)?;
        let contents = safetensors::contents(path, &file)?;
        Self::of(path, file, contents, architecture)
    }

    /// Generates reproducible weights.
    pub fn seeded(architecture: DepthArchitecture, key: &str) -> Result<Self> {
        architecture.validate()?;
        let (parameters, provenance) = (architecture.parameters(), format!("seeded:{key}"));
        let (source, of_gaussians) = (Source::Seeded { key: key.into() }, architecture.gaussians);
        Ok(Self { architecture, parameters, source, provenance, of_gaussians })
    }

    fn of(path: &Path, file: Bytes, mut contents: Contents, architecture: DepthArchitecture) -> Result<Self> {
        architecture.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
        let parameters = architecture.parameters();
        let of_gaussians = contents.tensors.keys().any(|name| name.starts_with(GAUSSIANS));
        let wanted = |name: &str| parameters.iter().any(|(other, _)| other == name);
        contents.tensors.retain(|name, _| wanted(name) || !is_unused(name));
        let tensors = matching(path, &architecture.name, &parameters, contents)?;
        let provenance = path.display().to_string();
        Ok(Self { architecture, parameters, source: Source::Stored { file, tensors }, provenance, of_gaussians })
    }

    /// Architecture of the weights.
    pub fn architecture(&self) -> &DepthArchitecture {
        &self.architecture
    }

    /// Bytes per stored type.
    pub fn stored(&self) -> BTreeMap<&'static str, u64> {
        self.source.stored(&self.parameters)
    }

    /// Stored bytes.
    pub fn bytes(&self) -> u64 {
        self.stored().values().sum()
    }

    /// Writes safetensors; 8-bit weights load as f32.
    pub fn save_with(
        &self,
        path: impl AsRef<Path>,
        dtype: Dtype,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<()> {
        safetensors::save(self, path.as_ref(), dtype, progress)
    }

    fn find(&self, name: &str) -> Result<usize> {
        let unknown = || Error::argument("tensor", name, format!("a parameter of {}", self.architecture.name));
        self.parameters.iter().position(|(other, _)| other == name).ok_or_else(unknown)
    }

    /// Origin of the weights.
    pub fn provenance(&self) -> &str {
        &self.provenance
    }

    /// Name and shape per tensor.
    pub fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

    /// Reads a tensor in C order.
    pub fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.source.read(&self.provenance, self.find(name)?, &self.parameters, out)
    }
}

impl safetensors::Weights for DepthCheckpoint {
    fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

    fn network(&self) -> safetensors::Stated<'_> {
        safetensors::Stated::Depth(&self.architecture)
    }
}

impl ParameterSource for DepthCheckpoint {
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.read_f32(name, out)
    }

    fn read_q8(&self, name: &str) -> Result<Q8> {
        self.source.read_q8(&self.provenance, self.find(name)?, &self.parameters)
    }
}

fn with_or_without(known: DepthArchitecture, gaussians: bool) -> Result<DepthArchitecture> {
    if gaussians && !known.gaussians {
        return Err(Error::argument(
            "network for Gaussians",
            &known.name,
            "da3-giant, which alone has a head for them",
        ));
    }
    Ok(DepthArchitecture { gaussians, ..known })
}

fn is_unused(name: &str) -> bool {
    let tails = [GAUSSIANS, "model.head.scratch.output_conv1_aux.", "model.head.scratch.output_conv2_aux."];
    tails.iter().any(|tail| name.starts_with(tail))
}

struct Shapes<'a>(&'a Contents);

impl Shapes<'_> {
    fn axis(&self, name: &str, axis: usize) -> Option<usize> {
        self.0.tensors.get(name)?.shape.get(axis).copied()
    }

    fn architecture(&self, path: &Path) -> Result<DepthArchitecture> {
        let block = |i: usize, part: &str| format!("{BACKBONE}.blocks.{i}.{part}");
        let width = self.axis(&format!("{BACKBONE}.norm.weight"), 0);
        let depth = (0..MAX_DEPTH).take_while(|&i| self.axis(&block(i, "norm1.weight"), 0).is_some()).count();
        let multi_view = self.axis(&format!("{BACKBONE}.camera_token"), 0).is_some();
        let gated = self.axis(&block(0, "mlp.w3.weight"), 0).is_some();
        let mut fitting = Vec::new();
        for name in DEPTH_MODELS {
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
}
