//! Weights of Depth Anything 3 networks, by the names of released files.

use std::path::Path;

use super::checkpoint::{Bytes, matching};
use super::contents::Contents;
use super::tensor::Stored;
use super::{DEPTH_MODELS, DepthArchitecture, Ffn, safetensors, seeded};
use crate::{Error, Result, stages::MAX_DEPTH};

const BACKBONE: &str = "model.backbone.pretrained";

/// The weights that depth needs, read one tensor at a time.
#[derive(Debug)]
pub struct DepthCheckpoint {
    architecture: DepthArchitecture,
    /// Name and shape.
    parameters: Vec<(String, Vec<usize>)>,
    source: Source,
    provenance: String,
}

#[derive(Debug)]
enum Source {
    /// A tensor for each parameter.
    Stored {
        file: Bytes,
        tensors: Vec<Stored>,
    },
    Seeded {
        key: String,
    },
}

impl DepthCheckpoint {
    /// `seeded:NAME`, of one of [`DEPTH_MODELS`], or the path of a file, as [`DepthCheckpoint::open`].
    ///
    /// # Errors
    /// As [`DepthCheckpoint::open`].
    pub fn parse(text: &str) -> Result<Self> {
        match text.strip_prefix("seeded:") {
            Some(name) => Self::seeded(DepthArchitecture::named(name)?, name),
            None => Self::open(text),
        }
    }

    /// Opens a released file, `model.safetensors`, of F32, F16, BF16, or F64 that is rounded to F32. Its tensors say which network it
    /// is; those that depth does not need are not read.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Format`] for the file; [`Error::Argument`] for a network that is none of [`DEPTH_MODELS`];
    /// [`Error::Weights`] lists every tensor that is missing, unexpected or misshapen.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let file = Bytes::open(path)?;
        let contents = safetensors::contents(path, &file)?;
        let architecture = Shapes(&contents).architecture(path)?;
        Self::of(path, file, contents, architecture)
    }

    /// As [`DepthCheckpoint::open`], for a network that the caller knows.
    ///
    /// # Errors
    /// As [`DepthCheckpoint::open`].
    pub fn open_architecture(path: impl AsRef<Path>, architecture: DepthArchitecture) -> Result<Self> {
        let path = path.as_ref();
        let file = Bytes::open(path)?;
        let contents = safetensors::contents(path, &file)?;
        Self::of(path, file, contents, architecture)
    }

    /// Reproducible weights; `key` names the stream of values.
    ///
    /// # Errors
    /// As [`DepthArchitecture::validate`].
    pub fn seeded(architecture: DepthArchitecture, key: &str) -> Result<Self> {
        architecture.validate()?;
        let (parameters, provenance) = (architecture.parameters(), format!("seeded:{key}"));
        Ok(Self { architecture, parameters, source: Source::Seeded { key: key.into() }, provenance })
    }

    fn of(path: &Path, file: Bytes, mut contents: Contents, architecture: DepthArchitecture) -> Result<Self> {
        architecture.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
        let parameters = architecture.parameters();
        let wanted = |name: &str| parameters.iter().any(|(other, _)| other == name);
        contents.tensors.retain(|name, _| wanted(name) || !is_unused(name));
        let tensors = matching(path, &architecture.name, &parameters, contents)?;
        let provenance = path.display().to_string();
        Ok(Self { architecture, parameters, source: Source::Stored { file, tensors }, provenance })
    }

    /// The network that these are the weights of.
    pub fn architecture(&self) -> &DepthArchitecture {
        &self.architecture
    }

    /// Where the weights come from.
    pub fn provenance(&self) -> &str {
        &self.provenance
    }

    /// Name and shape of every tensor.
    pub fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

    /// Reads a tensor in C order. `out` has as many values as the tensor.
    ///
    /// # Errors
    /// [`Error::Argument`] for an unknown name or a wrong length, [`Error::Format`] for a value that is not finite.
    pub fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        let unknown = || Error::argument("tensor", name, format!("a parameter of {}", self.architecture.name));
        let index = self.parameters.iter().position(|(other, _)| other == name).ok_or_else(unknown)?;
        let shape = &self.parameters[index].1;
        let expected: usize = shape.iter().product();
        if out.len() != expected {
            return Err(Error::argument(format!("buffer for {name}"), out.len(), format!("{expected} values")));
        }
        match &self.source {
            Source::Stored { file, tensors } => tensors[index].read(file, out),
            Source::Seeded { key } => seeded::fill(key, name, shape, out),
        }
        match out.iter().position(|value| !value.is_finite()) {
            Some(i) => {
                let reason = format!("{name}: found {} as value {i}, expected finite values", out[i]);
                Err(Error::format(&self.provenance, None, reason))
            }
            None => Ok(()),
        }
    }
}

/// Tensors of released files that depth does without: the head for Gaussians, and tails of the rays' head that lead nowhere.
fn is_unused(name: &str) -> bool {
    let tails = ["model.gs_head.", "model.head.scratch.output_conv1_aux.", "model.head.scratch.output_conv2_aux."];
    tails.iter().any(|tail| name.starts_with(tail))
}

/// The shapes of a file's tensors.
struct Shapes<'a>(&'a Contents);

impl Shapes<'_> {
    fn axis(&self, name: &str, axis: usize) -> Option<usize> {
        self.0.tensors.get(name)?.shape.get(axis).copied()
    }

    /// The released network that the tensors are of.
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
        // Two are of one layout.
        Ok(DepthArchitecture { name: names, ..first })
    }
}
