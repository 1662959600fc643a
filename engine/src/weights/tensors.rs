use super::{safetensors, tensor::Stored, values::matching};
use crate::{Error, Result, ops::ParameterSource, types::open_file};
use std::{collections::HashMap, io::Read, path::Path};

/// Requested tensors of a safetensors file.
pub struct Tensors {
    file: Vec<u8>,
    tensors: HashMap<String, Stored>,
}

impl Tensors {
    /// Opens a file with exactly these tensors, as [`Checkpoint::open`](super::Checkpoint::open).
    pub fn open(path: &Path, network: &str, parameters: &[(String, Vec<usize>)]) -> Result<Self> {
        let mut file = Vec::new();
        open_file(path)?.read_to_end(&mut file).map_err(|error| Error::io(path, error))?;
        let contents = safetensors::contents(path, &file)?;
        let found = matching(path, network, parameters, contents.tensors)?;
        let tensors = parameters.iter().map(|(name, _)| name.clone()).zip(found).collect();
        Ok(Self { file, tensors })
    }
}

impl ParameterSource for Tensors {
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self.tensors[name].read(&self.file, out);
        Ok(())
    }
}
