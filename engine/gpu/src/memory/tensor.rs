use super::element::Element;
use crate::plan::layout::ALIGNMENT;

/// A range of device memory, an array to kernels; a handle without ownership.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tensor {
    pub(crate) home: Home,
    pub(crate) offset: u64,
    pub(crate) bytes: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Home {
    Arena(u32),
    Resident { layout: u64, block: u32 },
}

impl Tensor {
    /// Returns `len` elements from element `first`.
    ///
    /// # Panics
    /// If the slice exceeds the tensor or does not start at a multiple of 256 bytes.
    pub fn slice<T>(&self, first: usize, len: usize) -> Tensor {
        let size = size_of::<T>() as u64;
        let (from, bytes) = (first as u64 * size, len as u64 * size);
        assert!(from.is_multiple_of(ALIGNMENT), "slice at byte {from} is not on a 256-byte boundary");
        assert!(from + bytes <= self.bytes, "slice {from}+{bytes} of {} bytes", self.bytes);
        Tensor { offset: self.offset + from, bytes, ..*self }
    }

    /// As [`Tensor::slice`], with a runtime element type.
    pub fn slice_of(&self, element: Element, first: usize, len: usize) -> Tensor {
        let bytes = element.bytes();
        self.slice::<u8>(bytes * first, bytes * len)
    }

    /// Returns the length in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// # Panics
    /// For a resident tensor: see [`Resident`](crate::Resident).
    pub(crate) fn allocation(self) -> usize {
        match self.home {
            Home::Arena(id) => id as usize,
            Home::Resident { .. } => panic!("resident tensors are written through their own memory"),
        }
    }
}
