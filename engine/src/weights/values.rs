use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use super::contents::Contents;
use super::source::{Bytes, Source};
use super::tensor::Stored;
use super::{safetensors, torch};
use crate::ops::{ParameterSource, Q8};
use crate::{Error, Result};

/// A network's tensors, read one by one to bound memory.
#[derive(Debug)]
pub struct Values {
    network: String,
    parameters: Vec<(String, Vec<usize>)>,
    source: Source,
    provenance: String,
}

impl Values {
    pub fn open(path: &Path, network: &str, parameters: Vec<(String, Vec<usize>)>) -> Result<Self> {
        let file = Bytes::open(path)?;
        let contents = safetensors::contents(path, &file)?;
        Self::in_file(path, file, network, parameters, contents)
    }

    pub(super) fn seeded(network: &str, parameters: Vec<(String, Vec<usize>)>, key: &str, provenance: String) -> Self {
        Self { network: network.into(), parameters, source: Source::Seeded { key: key.into() }, provenance }
    }

    pub(super) fn in_file(
        path: &Path,
        file: Bytes,
        network: &str,
        parameters: Vec<(String, Vec<usize>)>,
        contents: Contents,
    ) -> Result<Self> {
        let tensors = matching(path, network, &parameters, contents.tensors)?;
        let source = Source::Stored { file, tensors };
        Ok(Self { network: network.into(), parameters, source, provenance: path.display().to_string() })
    }

    pub fn parameters(&self) -> &[(String, Vec<usize>)] {
        &self.parameters
    }

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
    /// As [`Values::read_f32`], and for values or scales out of range.
    pub fn read_q8(&self, name: &str) -> Result<Q8> {
        self.source.read_q8(&self.provenance, self.find(name)?, &self.parameters)
    }

    pub fn q8_names(&self) -> impl Iterator<Item = &str> {
        let is_q8 = |i: usize| matches!(&self.source, Source::Stored { tensors, .. } if tensors[i].is_q8());
        self.tensor_names().enumerate().filter(move |(i, _)| is_q8(*i)).map(|(_, name)| name)
    }

    pub fn stored(&self) -> BTreeMap<&'static str, u64> {
        self.source.stored(&self.parameters)
    }

    pub fn bytes(&self) -> u64 {
        self.stored().values().sum()
    }

    /// A path or `seeded:NETWORK:KEY`.
    pub fn provenance(&self) -> &str {
        &self.provenance
    }

    fn find(&self, name: &str) -> Result<usize> {
        let unknown = || Error::argument("tensor", name, format!("a parameter of {}", self.network));
        self.tensor_names().position(|other| other == name).ok_or_else(unknown)
    }
}

impl ParameterSource for Values {
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.read_f32(name, out)
    }

    fn read_q8(&self, name: &str) -> Result<Q8> {
        self.read_q8(name)
    }
}

/// Reads safetensors or a `torch.save` archive.
pub(super) fn contents(path: &Path, file: &[u8]) -> Result<Contents> {
    if torch::is_archive(file) { torch::contents(path, file) } else { safetensors::contents(path, file) }
}

/// All parameters must have tensors.
fn matching(
    path: &Path,
    network: &str,
    parameters: &[(String, Vec<usize>)],
    mut found: HashMap<String, Stored>,
) -> Result<Vec<Stored>> {
    let (mut tensors, mut missing, mut misshapen) = (Vec::new(), Vec::new(), Vec::new());
    for (name, expected) in parameters {
        match found.remove(name) {
            Some(tensor) if tensor.shape == *expected => tensors.push(tensor),
            Some(tensor) => misshapen.push(format!("{name}: found {:?}, expected {expected:?}", tensor.shape)),
            None => missing.push(name.clone()),
        }
    }
    let mut unexpected: Vec<String> = found.into_keys().collect();
    unexpected.sort();
    if missing.is_empty() && unexpected.is_empty() && misshapen.is_empty() {
        return Ok(tensors);
    }
    Err(Error::Weights { path: path.into(), architecture: network.into(), missing, unexpected, misshapen })
}
