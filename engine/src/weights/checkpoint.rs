use std::borrow::Cow;
use std::ops::{ControlFlow, Deref};
use std::path::Path;

use super::contents::Contents;
use super::save::save;
use super::source::Bytes;
use super::values::{Values, contents};
use super::{Architecture, Dtype, inference, safetensors};
use crate::ops::Arithmetic;
use crate::types::preprocess::DEFAULT_SIZE;
use crate::{Error, Result};

pub const BUILTIN: &str = "builtin";

/// An [`Architecture`] with its tensors.
#[derive(Debug)]
pub struct Checkpoint {
    architecture: Architecture,
    values: Values,
    image_size: u32,
    notes: Vec<String>,
}

impl Deref for Checkpoint {
    type Target = Values;

    fn deref(&self) -> &Values {
        &self.values
    }
}

#[cfg(feature = "embedded-model")]
const EMBEDDED: &[u8] = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/models/nano.safetensors"));

type Identified = (Architecture, Option<String>);

impl Checkpoint {
    /// Returns the model of `engine/models/README.md`, or [`Error::Argument`] without feature
    /// `embedded-model`.
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
    /// Drops wrappers `module` and `_orig_mod`. An unstated architecture follows from shapes, the
    /// training configuration and `variant`: one of [`VARIANTS`](super::VARIANTS) or
    /// [`RECIPES`](super::RECIPES), with overrides `:out_layers=A,B,..`, `:alt_start=N`,
    /// `:rope_start=N`, `:camera_heads=N`, `:gaussians_per_token=N`, `:sh_degree=N`.
    /// [`Checkpoint::notes`] lists assumptions.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Format`]; [`Error::Argument`] for a non-regular file or an
    /// unsuitable variant; [`Error::Weights`] lists missing, unexpected and misshapen tensors.
    pub fn open(path: impl AsRef<Path>, variant: Option<&str>) -> Result<Self> {
        Self::load(path.as_ref(), |contents, path| inference::architecture(contents, path, variant))
    }

    /// `name` is for messages.
    pub fn from_bytes(name: &str, bytes: impl Into<Cow<'static, [u8]>>, variant: Option<&str>) -> Result<Self> {
        Self::from_file(Path::new(name), Bytes::Held(bytes.into()), |contents, path| {
            inference::architecture(contents, path, variant)
        })
    }

    pub fn open_architecture(path: impl AsRef<Path>, architecture: Architecture) -> Result<Self> {
        architecture.validate()?;
        Self::load(path.as_ref(), |_, _| Ok((architecture, None)))
    }

    /// Reproducible; `key` defaults to the variant.
    pub fn seeded(variant: &str, key: Option<&str>) -> Result<Self> {
        Self::seeded_architecture(Architecture::named(variant)?, key.unwrap_or(variant))
    }

    pub fn seeded_architecture(architecture: Architecture, key: &str) -> Result<Self> {
        architecture.validate()?;
        let stream = if key == architecture.name { String::new() } else { format!(":{key}") };
        let provenance = format!("seeded:{}{stream}", architecture.name);
        let values = Values::seeded(&architecture.name, architecture.parameters(), key, provenance);
        Ok(Self { architecture, values, image_size: DEFAULT_SIZE, notes: Vec::new() })
    }

    fn load(path: &Path, architecture: impl FnOnce(&Contents, &Path) -> Result<Identified>) -> Result<Self> {
        Self::from_file(path, Bytes::open(path)?, architecture)
    }

    fn from_file(
        path: &Path,
        file: Bytes,
        architecture: impl FnOnce(&Contents, &Path) -> Result<Identified>,
    ) -> Result<Self> {
        let contents = contents(path, &file)?;
        let (architecture, assumed) = architecture(&contents, path)?;
        let rounded = contents.doubles();
        let rounded = (rounded > 0).then(|| format!("{}: {rounded} tensors of f64 are rounded to f32", path.display()));
        let image_size = contents.image_size.unwrap_or(DEFAULT_SIZE);
        let notes = assumed.into_iter().chain(rounded).collect();
        let values = Values::in_file(path, file, &architecture.name, architecture.parameters(), contents)?;
        Ok(Self { architecture, values, image_size, notes })
    }

    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// Training image side in pixels, by default 252.
    pub fn image_size(&self) -> u32 {
        self.image_size
    }

    /// [`Error::Argument`] for 8-bit arithmetic with [`Q8`] weights.
    pub fn suits(&self, arithmetic: Arithmetic) -> Result<()> {
        if !arithmetic.has_integers() || self.q8_names().next().is_none() {
            return Ok(());
        }
        let found = format!("int8 for {}, whose weights are q8", self.provenance());
        Err(Error::argument("precision", found, "fp32, fp16 or bf16; int8 rounds weights of f32, f16 or bf16"))
    }

    /// Rounding and assumptions, for the user.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Writes safetensors atomically.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Argument`] for values beyond `dtype`; those of [`Values::read_f32`].
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
        let stated = [
            (safetensors::ARCHITECTURE_KEY, serde_json::to_string(&self.architecture)),
            (safetensors::IMAGE_SIZE_KEY, Ok(self.image_size.to_string())),
        ];
        save(self, stated, path.as_ref(), dtype, progress)
    }
}
