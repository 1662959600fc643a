//! Where the values of parameters lie.

use super::{checkpoint::Bytes, seeded, tensor::Stored};
use crate::{Error, Result};

/// The values of a list of parameters.
#[derive(Debug)]
pub(super) enum Source {
    /// A tensor for each parameter.
    Stored {
        file: Bytes,
        tensors: Vec<Stored>,
    },
    Seeded {
        key: String,
    },
}

impl Source {
    /// Reads parameter `index` of those that it has, in C order; `provenance` stands for all of them in messages.
    ///
    /// # Errors
    /// [`Error::Argument`] for a wrong length, [`Error::Format`] for a value that is not finite.
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
}
