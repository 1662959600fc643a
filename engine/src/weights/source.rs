use super::{Dtype, safetensors::too_small, seeded, tensor::Stored};
use crate::{Error, Result, ops::Q8, stages::parameter_count, types::open_file};
use memmap2::Mmap;
use std::{borrow::Cow, collections::BTreeMap, ops::Deref, path::Path};

#[derive(Debug)]
pub(super) enum Bytes {
    Mapped(Mmap),
    Held(Cow<'static, [u8]>),
}

impl Deref for Bytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(file) => file,
            Self::Held(bytes) => bytes,
        }
    }
}

impl Bytes {
    pub fn open(path: &Path) -> Result<Self> {
        let file = open_file(path)?;
        // SAFETY: every byte is valid to read. Truncation by another process raises SIGBUS, as for
        // any mapped file; `save` replaces files and never truncates.
        #[allow(unsafe_code)]
        let file = unsafe { Mmap::map(&file) }.map_err(|error| Error::io(path, error))?;
        Ok(Self::Mapped(file))
    }
}

#[derive(Debug)]
pub(super) enum Source {
    /// One tensor per parameter.
    Stored {
        file: Bytes,
        tensors: Vec<Stored>,
    },
    Seeded {
        key: String,
    },
}

impl Source {
    pub fn read(
        &self,
        provenance: &str,
        index: usize,
        parameters: &[(String, Vec<usize>)],
        out: &mut [f32],
    ) -> Result<()> {
        let (name, shape) = &parameters[index];
        let expected: usize = shape.iter().product();
        if out.len() != expected {
            return Err(Error::argument(format!("buffer for {name}"), out.len(), format!("{expected} values")));
        }
        match self {
            Self::Stored { file, tensors } => tensors[index].read(file, out),
            Self::Seeded { key } => seeded::fill(key, name, shape, out),
        }
        match out.iter().position(|value| !value.is_finite()) {
            Some(i) => {
                let reason = format!("{name}: found {} as value {i}, expected finite values", out[i]);
                Err(Error::format(provenance, None, reason))
            }
            None => Ok(()),
        }
    }

    pub fn read_q8(&self, provenance: &str, index: usize, parameters: &[(String, Vec<usize>)]) -> Result<Q8> {
        let (name, shape) = &parameters[index];
        match self {
            Self::Stored { file, tensors } if tensors[index].is_q8() => {
                let found = tensors[index].read_q8(file);
                let usable = |scale: f32| scale == 0.0 || Q8::SCALES.contains(&scale);
                match found.scales.iter().position(|scale| !usable(scale.to_f32())) {
                    Some(i) => {
                        let expected = format!("0 or {:?}", Q8::SCALES);
                        let reason = format!("{name}: found scale {i} of {}, expected {expected}", found.scales[i]);
                        Err(Error::format(provenance, None, reason))
                    }
                    None => Ok(found),
                }
            }
            _ => {
                let mut values = vec![0.0; shape.iter().product()];
                self.read(provenance, index, parameters, &mut values)?;
                let largest = || values.iter().fold(0f32, |most, x| if x.abs() > most.abs() { *x } else { most });
                Q8::round(&values).ok_or_else(|| too_small(Dtype::Q8, name, largest()))
            }
        }
    }

    pub fn stored(&self, parameters: &[(String, Vec<usize>)]) -> BTreeMap<&'static str, u64> {
        let mut stored = BTreeMap::new();
        match self {
            Self::Stored { tensors, .. } => {
                let kind = |tensor: &Stored| if tensor.is_q8() { Dtype::Q8.name() } else { tensor.dtype.name() };
                tensors.iter().for_each(|tensor| *stored.entry(kind(tensor)).or_default() += tensor.bytes() as u64);
            }
            Self::Seeded { .. } => {
                stored.insert(Dtype::F32.name(), (size_of::<f32>() * parameter_count(parameters)) as u64);
            }
        }
        stored
    }
}
