use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use super::contents::Contents;
use super::source::{Bytes, Source};
use super::tensor::Stored;
use super::{Architecture, Dtype, inference, safetensors, torch};
use crate::ops::{Arithmetic, ParameterSource, Q8};
use crate::types::preprocess::DEFAULT_SIZE;
use crate::{Error, Result};

/// Name of the library's own model.
pub const BUILTIN: &str = "builtin";

/// An [`Architecture`]'s tensors, read one at a time to bound memory.
#[derive(Debug)]
pub struct Checkpoint {
    architecture: Architecture,
    parameters: Vec<(String, Vec<usize>)>,
    image_size: u32,
    source: Source,
    provenance: String,
    notes: Vec<String>,
}

#[cfg(feature = "embedded-model")]
const EMBEDDED: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/nano.safetensors"));

type Identified = (Architecture, Option<String>);

impl Checkpoint {
    /// Returns the model of `engine/models/README.md`.
    ///
    /// # Errors
    /// [`Error::Argument`] without feature `embedded-model`.
    pub fn builtin() -> Result<Self> {
        #[cfg(feature = "embedded-model")]
        let found = Self::from_bytes("the embedded model", EMBEDDED, None);
        #[cfg(not(feature = "embedded-model"))]
        let found = {
            let expected = "a checkpoint: this build has no embedded model (cargo feature embedded-model)";
            Err(Error::argument("weights", "none", expected))
        };
        found
    }

    /// Opens `builtin`, `seeded:VARIANT[:KEY]` or a path.
    pub fn parse(text: &str, variant: Option<&str>) -> Result<Self> {
        if text == BUILTIN && variant.is_none() {
            return Self::builtin();
        }
        let Some(seed) = text.strip_prefix("seeded:") else { return Self::open(text, variant) };
        let (name, key) = seed.split_once(':').map_or((seed, None), |(name, key)| (name, Some(key)));
        match variant {
            Some(variant) if variant != name => {
                Err(Error::argument("variant", variant, format!("{name}, as in {text}")))
            }
            _ => Self::seeded(name, key),
        }
    }

    /// Opens safetensors or a `torch.save` state dictionary, alone or as entry `model`, of F32,
    /// F16, BF16 or F64 (rounded to F32).
    ///
    /// Wrappers `module` and `_orig_mod` are dropped from names. An unstated architecture follows
    /// from shapes, the training configuration and `variant`: one of [`VARIANTS`](super::VARIANTS)
    /// or [`RECIPES`](super::RECIPES), with overrides `:out_layers=A,B,..`, `:alt_start=N`,
    /// `:rope_start=N`, `:camera_heads=N`, `:gaussians_per_token=N`, `:sh_degree=N`.
    /// [`Checkpoint::notes`] lists assumptions.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Format`]; [`Error::Argument`] for a non-regular file or an
    /// unsuitable variant; [`Error::Weights`] lists missing, unexpected and misshapen tensors.
    pub fn open(path: impl AsRef<Path>, variant: Option<&str>) -> Result<Self> {
        Self::load(path.as_ref(), |contents, path| inference::architecture(contents, path, variant))
    }

    /// Opens a file's contents, called `name` in messages.
    pub fn from_bytes(name: &str, bytes: impl Into<Cow<'static, [u8]>>, variant: Option<&str>) -> Result<Self> {
        Self::from_file(Path::new(name), Bytes::Held(bytes.into()), |contents, path| {
            inference::architecture(contents, path, variant)
        })
    }

    /// Opens a file with a known architecture.
    pub fn open_architecture(path: impl AsRef<Path>, architecture: Architecture) -> Result<Self> {
        architecture.validate()?;
        Self::load(path.as_ref(), |_, _| Ok((architecture, None)))
    }

    /// Generates reproducible weights; `key` defaults to the variant.
    pub fn seeded(variant: &str, key: Option<&str>) -> Result<Self> {
        Self::seeded_architecture(Architecture::named(variant)?, key.unwrap_or(variant))
    }

    /// Generates reproducible weights.
    pub fn seeded_architecture(architecture: Architecture, key: &str) -> Result<Self> {
        architecture.validate()?;
        let stream = if key == architecture.name { String::new() } else { format!(":{key}") };
        let provenance = format!("seeded:{}{stream}", architecture.name);
        let parameters = architecture.parameters();
        let source = Source::Seeded { key: key.into() };
        Ok(Self { architecture, parameters, image_size: DEFAULT_SIZE, source, provenance, notes: Vec::new() })
    }

    fn load(path: &Path, architecture: impl FnOnce(&Contents, &Path) -> Result<Identified>) -> Result<Self> {
        Self::from_file(path, Bytes::open(path)?, architecture)
    }

    fn from_file(
        path: &Path,
        file: Bytes,
        architecture: impl FnOnce(&Contents, &Path) -> Result<Identified>,
    ) -> Result<Self> {
        let contents =
            if torch::is_archive(&file) { torch::contents(path, &file)? } else { safetensors::contents(path, &file)? };
        let (architecture, assumed) = architecture(&contents, path)?;
        let rounded = contents.doubles();
        let rounded = (rounded > 0).then(|| format!("{}: {rounded} tensors of f64 are rounded to f32", path.display()));
        let parameters = architecture.parameters();
        let image_size = contents.image_size.unwrap_or(DEFAULT_SIZE);
        let tensors = matching(path, &architecture.name, &parameters, contents)?;
        let provenance = path.display().to_string();
        let source = Source::Stored { file, tensors };
        let notes = assumed.into_iter().chain(rounded).collect();
        Ok(Self { architecture, parameters, image_size, source, provenance, notes })
    }

    /// Architecture of the weights.
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// Training image side in pixels, by default 252.
    pub fn image_size(&self) -> u32 {
        self.image_size
    }

    /// Name and shape per tensor.
    pub fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

    /// Tensor names.
    pub fn tensor_names(&self) -> impl Iterator<Item = &str> {
        self.parameters.iter().map(|(name, _)| name.as_str())
    }

    /// Shape of a tensor; [`Error::Argument`] if unknown.
    pub fn shape(&self, name: &str) -> Result<&[usize]> {
        self.find(name).map(|i| self.parameters[i].1.as_slice())
    }

    /// Reads a tensor in C order.
    ///
    /// # Errors
    /// [`Error::Argument`] for a wrong name or length, [`Error::Format`] for nonfinite values.
    pub fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.source.read(&self.provenance, self.find(name)?, &self.parameters, out)
    }

    /// Reads a matrix of whole groups in 8 bits.
    ///
    /// # Errors
    ///
    /// As [`Checkpoint::read_f32`], and for values or scales out of range.
    pub fn read_q8(&self, name: &str) -> Result<Q8> {
        self.source.read_q8(&self.provenance, self.find(name)?, &self.parameters)
    }

    /// Names of [`Q8`] tensors.
    pub fn q8_names(&self) -> impl Iterator<Item = &str> {
        let is_q8 = |i: usize| matches!(&self.source, Source::Stored { tensors, .. } if tensors[i].is_q8());
        self.tensor_names().enumerate().filter(move |(i, _)| is_q8(*i)).map(|(_, name)| name)
    }

    /// Checks that an arithmetic supports these weights.
    ///
    /// # Errors
    /// [`Error::Argument`] for 8-bit arithmetic with [`Q8`] weights.
    pub fn suits(&self, arithmetic: Arithmetic) -> Result<()> {
        if !arithmetic.has_integers() || self.q8_names().next().is_none() {
            return Ok(());
        }
        let found = format!("int8 for {}, whose weights are q8", self.provenance);
        Err(Error::argument("precision", found, "fp32, fp16 or bf16; int8 rounds weights of f32, f16 or bf16"))
    }

    /// Bytes per stored type.
    pub fn stored(&self) -> BTreeMap<&'static str, u64> {
        self.source.stored(&self.parameters)
    }

    /// Stored bytes.
    pub fn bytes(&self) -> u64 {
        self.stored().values().sum()
    }

    /// Origin of the weights: a path or `seeded:VARIANT:KEY`.
    pub fn provenance(&self) -> &str {
        &self.provenance
    }

    /// Notes for the user about rounding and assumptions.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Writes safetensors atomically.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Argument`] for values beyond `dtype`; those of
    /// [`Checkpoint::read_f32`].
    pub fn save(&self, path: impl AsRef<Path>, dtype: Dtype) -> Result<()> {
        self.save_with(path, dtype, |_| ControlFlow::Continue(()))
    }

    /// [`Checkpoint::save`] with progress; canceling leaves no file.
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
        self.tensor_names().position(|other| other == name).ok_or_else(unknown)
    }
}

impl safetensors::Weights for Checkpoint {
    fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

    fn network(&self) -> safetensors::Stated<'_> {
        safetensors::Stated::Scene(&self.architecture, self.image_size)
    }
}

impl ParameterSource for Checkpoint {
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.read_f32(name, out)
    }

    fn read_q8(&self, name: &str) -> Result<Q8> {
        self.read_q8(name)
    }
}

pub(super) fn matching(
    path: &Path,
    network: &str,
    parameters: &[(String, Vec<usize>)],
    mut contents: Contents,
) -> Result<Vec<Stored>> {
    let (mut tensors, mut missing, mut misshapen) = (Vec::new(), Vec::new(), Vec::new());
    for (name, expected) in parameters {
        match contents.tensors.remove(name) {
            Some(tensor) if tensor.shape == *expected => tensors.push(tensor),
            Some(tensor) => misshapen.push(format!("{name}: found {:?}, expected {expected:?}", tensor.shape)),
            None => missing.push(name.clone()),
        }
    }
    let mut unexpected: Vec<String> = contents.tensors.into_keys().collect();
    unexpected.sort();
    if missing.is_empty() && unexpected.is_empty() && misshapen.is_empty() {
        return Ok(tensors);
    }
    let (path, architecture) = (PathBuf::from(path), network.to_owned());
    Err(Error::Weights { path, architecture, missing, unexpected, misshapen })
}
