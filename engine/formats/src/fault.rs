//! Faults of bytes, whose file the caller knows.

use crate::Error;
use std::path::Path;

pub(crate) struct Fault {
    pub offset: Option<usize>,
    pub reason: String,
}

pub(crate) type Parsed<T> = Result<T, Fault>;

impl Fault {
    pub fn at(offset: usize, reason: String) -> Self {
        Self { offset: Some(offset), reason }
    }

    pub fn in_file(self, path: &Path) -> Error {
        Error::format(path, self.offset.map(|at| at as u64), self.reason)
    }
}

impl From<String> for Fault {
    fn from(reason: String) -> Self {
        Self { offset: None, reason }
    }
}
