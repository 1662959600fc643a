//! Ranges of device memory.

use super::{element::Element, layout::ALIGNMENT};

/// A range of device memory that kernels see as one array. Copy it freely; it owns nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tensor {
    pub(super) home: Home,
    pub(super) offset: u64,
    pub(super) bytes: u64,
}

/// The place of a tensor's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Home {
    /// Allocation number of the plan; its place is known once the plan is finished.
    Arena(u32),
    /// A block of the resident memory of this layout.
    Resident { layout: u64, block: u32 },
}

impl Tensor {
    /// `len` elements from element `first` on.
    ///
    /// # Panics
    /// A slice that is outside the tensor or not on a boundary of 256 bytes.
    pub fn slice<T>(&self, first: usize, len: usize) -> Tensor {
        let size = size_of::<T>() as u64;
        let (from, bytes) = (first as u64 * size, len as u64 * size);
        assert!(from.is_multiple_of(ALIGNMENT), "slice at byte {from} is not on a 256-byte boundary");
        assert!(from + bytes <= self.bytes, "slice {from}+{bytes} of {} bytes", self.bytes);
        Tensor { offset: self.offset + from, bytes, ..*self }
    }

    /// As [`Tensor::slice`], of a type that is known when it is recorded.
    ///
    /// # Panics
    /// As [`Tensor::slice`].
    pub fn slice_of(&self, element: Element, first: usize, len: usize) -> Tensor {
        let bytes = element.bytes();
        self.slice::<u8>(bytes * first, bytes * len)
    }

    /// Length in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// The tensor's number among a plan's allocations.
    ///
    /// # Panics
    /// A resident tensor: such are written and read through their own memory.
    pub(super) fn allocation(self) -> usize {
        match self.home {
            Home::Arena(id) => id as usize,
            Home::Resident { .. } => panic!("resident tensors are written through their own memory"),
        }
    }
}
