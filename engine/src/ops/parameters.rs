//! A model's parameters on the device: laid out from shapes alone, then loaded from a checkpoint.

use super::{Linear, Norm};
use crate::{
    Error, Result,
    gpu::{Device, Limits, Resident, ResidentLayout, Tensor},
    kernels::limits::PANEL_COLUMNS,
    weights::Checkpoint,
};
use rayon::prelude::*;
use std::ops::ControlFlow;

/// Where every parameter goes, and how it is packed there.
pub struct ParameterLayout {
    layout: ResidentLayout,
    uploads: Vec<Upload>,
}

struct Upload {
    name: String,
    tensor: Tensor,
    packing: Packing,
}

/// How a checkpoint's `[columns, inner]` matrix becomes the `[panels, inner, PANEL_COLUMNS]` one that kernels read.
#[derive(Clone, Copy)]
enum Packing {
    /// As it is.
    Vector,
    /// Transposed panel by panel; `inner` padded with zeros to a multiple of 4, columns to whole panels.
    Matrix { inner: usize, columns: usize },
    /// As `Matrix`, its first and second half of columns alternating: gate, value, gate, value.
    GatedMatrix { inner: usize, columns: usize },
    /// A vector in the order of a gated matrix' columns.
    GatedVector,
}

impl ParameterLayout {
    /// An empty layout for devices of these limits.
    pub fn new(limits: &Limits) -> Self {
        Self { layout: ResidentLayout::new(limits), uploads: Vec::new() }
    }

    /// A parameter of `len` values as it is.
    pub fn vector(&mut self, name: String, len: usize) -> Tensor {
        self.add(name, len, Packing::Vector)
    }

    /// `NAME.weight` `[columns, inner]` (a convolution's kernel counts as one row an output) and `NAME.bias`.
    pub fn linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, inner, columns, Packing::Matrix { inner, columns }, Packing::Vector)
    }

    /// As [`ParameterLayout::linear`] for a layer whose output is [gate | value].
    pub fn gated_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, inner, columns, Packing::GatedMatrix { inner, columns }, Packing::GatedVector)
    }

    /// `NAME.weight` and `NAME.bias` of a layer norm.
    pub fn norm(&mut self, name: &str, width: usize, eps: f32) -> Norm {
        Norm {
            weight: self.vector(format!("{name}.weight"), width),
            bias: self.vector(format!("{name}.bias"), width),
            width,
            eps,
        }
    }

    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        self.layout.bytes()
    }

    /// Allocates the parameters and loads them one by one. `progress` gets the share that is done and may stop it.
    ///
    /// # Errors
    /// Where the device has too little memory, or the checkpoint cannot be read; [`Error::Cancelled`].
    pub fn load(
        &self,
        device: &Device,
        checkpoint: &Checkpoint,
        mut progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Resident> {
        let resident = Resident::new(device, &self.layout)?;
        let (mut source, mut packed) = (Vec::new(), Vec::new());
        let mut done = 0;
        for upload in &self.uploads {
            let len = checkpoint.shape(&upload.name)?.iter().product();
            source.resize(len, 0.0);
            checkpoint.read_f32(&upload.name, &mut source)?;
            upload.packing.pack(&source, &mut packed);
            resident.write(upload.tensor, &packed)?;
            done += upload.tensor.bytes();
            if progress(done as f64 / self.bytes() as f64).is_break() {
                return Err(Error::Cancelled);
            }
        }
        Ok(resident)
    }

    fn matrix(&mut self, name: &str, inner: usize, columns: usize, matrix: Packing, vector: Packing) -> Linear {
        let padded = inner.next_multiple_of(4) * columns.next_multiple_of(PANEL_COLUMNS as usize);
        Linear {
            weight: self.add(format!("{name}.weight"), padded, matrix),
            bias: self.add(format!("{name}.bias"), columns, vector),
            inner: inner.next_multiple_of(4),
            columns,
        }
    }

    fn add(&mut self, name: String, len: usize, packing: Packing) -> Tensor {
        let tensor = self.layout.add::<f32>(len);
        self.uploads.push(Upload { name, tensor, packing });
        tensor
    }
}

impl Packing {
    fn pack(self, source: &[f32], packed: &mut Vec<f32>) {
        packed.clear();
        match self {
            Packing::Vector => packed.extend_from_slice(source),
            Packing::GatedVector => {
                let half = source.len() / 2;
                packed.extend((0..half).flat_map(|i| [source[i], source[half + i]]));
            }
            Packing::Matrix { inner, columns } => transpose(source, inner, columns, packed, |column| column),
            Packing::GatedMatrix { inner, columns } => {
                transpose(source, inner, columns, packed, |column| (column % 2) * (columns / 2) + column / 2)
            }
        }
    }
}

/// The matrix `weight` `[columns, inner]` as [`Linear::weight`] holds it.
pub fn pack_matrix(weight: &[f32], inner: usize, columns: usize) -> Vec<f32> {
    let mut packed = Vec::new();
    Packing::Matrix { inner, columns }.pack(weight, &mut packed);
    packed
}

/// `[columns, inner]` -> `[panels, padded inner, PANEL_COLUMNS]`; column c comes from row `row_from_column(c)`.
fn transpose(
    source: &[f32],
    inner: usize,
    columns: usize,
    packed: &mut Vec<f32>,
    row_from_column: impl Fn(usize) -> usize + Sync,
) {
    const PANEL: usize = PANEL_COLUMNS as usize;
    let padded = inner.next_multiple_of(4);
    packed.resize(padded * columns.next_multiple_of(PANEL), 0.0);
    packed.par_chunks_mut(padded * PANEL).enumerate().for_each(|(p, panel)| {
        for column in p * PANEL..columns.min((p + 1) * PANEL) {
            let row = &source[row_from_column(column) * inner..][..inner];
            for (k, value) in row.iter().enumerate() {
                panel[k * PANEL + column % PANEL] = *value;
            }
        }
    });
}
