//! A model's parameters on the device: laid out from shapes alone, then loaded from a checkpoint.

use super::{Arithmetic, AttentionKernel, Linear, LinearKernel, Norm};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Resident, ResidentLayout, Tensor},
    kernels::limits::PANEL_COLUMNS,
    weights::Checkpoint,
};
use half::f16;
use rayon::prelude::*;
use std::ops::ControlFlow;

/// Where every parameter goes, and how it is packed there.
pub struct ParameterLayout {
    layout: ResidentLayout,
    uploads: Vec<Upload>,
    arithmetic: Arithmetic,
}

struct Upload {
    name: String,
    tensor: Tensor,
    packing: Packing,
}

/// How a checkpoint's values become what kernels read.
#[derive(Clone, Copy)]
enum Packing {
    /// As they are.
    Vector,
    /// A vector in the order of a gated matrix' columns.
    GatedVector,
    /// A `[columns, inner]` matrix as [`LinearKernel`] wants it. Padding is zero.
    Matrix { inner: usize, columns: usize, gated: bool, kernel: LinearKernel },
}

/// Row of a checkpoint's matrix that is column `column` of the packed one: of a gated one the first and second half
/// alternate, gate, value, gate, value.
fn source_row(column: usize, columns: usize, gated: bool) -> usize {
    if gated { (column % 2) * (columns / 2) + column / 2 } else { column }
}

impl ParameterLayout {
    /// An empty layout for devices of these limits.
    pub fn new(limits: &Limits, arithmetic: Arithmetic) -> Self {
        Self { layout: ResidentLayout::new(limits), uploads: Vec::new(), arithmetic }
    }

    /// The kernel of attention.
    pub fn attention(&self) -> AttentionKernel {
        match self.arithmetic {
            Arithmetic { attention: Some(shape), .. } => AttentionKernel::Matrix(shape),
            Arithmetic { element, .. } => AttentionKernel::Lanes(element),
        }
    }

    /// A parameter of `len` values as it is.
    pub fn vector(&mut self, name: String, len: usize) -> Tensor {
        self.add::<f32>(name, len, Packing::Vector)
    }

    /// `NAME.weight` `[columns, inner]` (a convolution's kernel counts as one row an output) and `NAME.bias`.
    pub fn linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, inner, columns, false, self.arithmetic)
    }

    /// As [`ParameterLayout::linear`], in f32 whatever the arithmetic: for what f16 cannot hold and costs nothing.
    pub fn exact_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, inner, columns, false, Arithmetic::EXACT)
    }

    /// As [`ParameterLayout::linear`] for a layer whose output is [gate | value].
    pub fn gated_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, inner, columns, true, self.arithmetic)
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

    fn matrix(&mut self, name: &str, inner: usize, columns: usize, gated: bool, arithmetic: Arithmetic) -> Linear {
        // The matrix kernel writes whole vectors.
        let kernel = match arithmetic.linear {
            Some(shape) if columns.is_multiple_of(if gated { 8 } else { 4 }) => LinearKernel::Matrix(shape),
            _ => LinearKernel::Panels(arithmetic.element),
        };
        let packing = Packing::Matrix { inner, columns, gated, kernel };
        let (weight, len) = (format!("{name}.weight"), packed_len(inner, columns, kernel));
        Linear {
            weight: match kernel.element() {
                Element::F32 => self.add::<f32>(weight, len, packing),
                Element::F16 => self.add::<u16>(weight, len, packing),
            },
            bias: self.add::<f32>(
                format!("{name}.bias"),
                columns,
                if gated { Packing::GatedVector } else { Packing::Vector },
            ),
            inner: inner.next_multiple_of(kernel.vector()),
            columns,
            kernel,
        }
    }

    fn add<T>(&mut self, name: String, len: usize, packing: Packing) -> Tensor {
        let tensor = self.layout.add::<T>(len);
        self.uploads.push(Upload { name, tensor, packing });
        tensor
    }
}

/// Values of a packed matrix.
fn packed_len(inner: usize, columns: usize, kernel: LinearKernel) -> usize {
    let inner = inner.next_multiple_of(kernel.vector());
    match kernel {
        LinearKernel::Panels(_) => inner * columns.next_multiple_of(PANEL_COLUMNS as usize),
        LinearKernel::Matrix(_) => inner * columns,
    }
}

impl Packing {
    /// The bytes that kernels read.
    fn pack(self, source: &[f32], packed: &mut Vec<u8>) {
        packed.clear();
        match self {
            Packing::Vector => packed.extend_from_slice(bytemuck::cast_slice(source)),
            Packing::GatedVector => {
                let value = |column| source[source_row(column, source.len(), true)];
                packed.extend((0..source.len()).flat_map(|column| value(column).to_ne_bytes()));
            }
            Packing::Matrix { inner, columns, gated, kernel } => {
                packed.resize(packed_len(inner, columns, kernel) * kernel.element().bytes(), 0);
                let row = |column: usize| &source[source_row(column, columns, gated) * inner..][..inner];
                match kernel {
                    LinearKernel::Panels(Element::F32) => panels(row, inner, columns, kernel, packed, f32::to_ne_bytes),
                    LinearKernel::Panels(Element::F16) => panels(row, inner, columns, kernel, packed, half),
                    LinearKernel::Matrix(_) => {
                        let padded = 2 * inner.next_multiple_of(kernel.vector());
                        packed.par_chunks_mut(padded).enumerate().for_each(|(column, out)| {
                            let (out, _) = out.as_chunks_mut::<2>();
                            out.iter_mut().zip(row(column)).for_each(|(out, value)| *out = half(*value));
                        });
                    }
                }
            }
        }
    }
}

/// A value as f16. One beyond its largest becomes that one.
fn half(value: f32) -> [u8; 2] {
    f16::from_f32(value.clamp(f16::MIN.to_f32(), f16::MAX.to_f32())).to_ne_bytes()
}

/// The bytes of the matrix `weight` `[columns, inner]` as `kernel` reads them.
pub fn pack_matrix(kernel: LinearKernel, weight: &[f32], inner: usize, columns: usize) -> Vec<u8> {
    let mut packed = Vec::new();
    Packing::Matrix { inner, columns, gated: false, kernel }.pack(weight, &mut packed);
    packed
}

/// Columns, each a row of a checkpoint's matrix, as `[panels, padded inner, PANEL_COLUMNS]`.
fn panels<'a, const N: usize>(
    row: impl Fn(usize) -> &'a [f32] + Sync,
    inner: usize,
    columns: usize,
    kernel: LinearKernel,
    packed: &mut [u8],
    encode: impl Fn(f32) -> [u8; N] + Sync,
) {
    const PANEL: usize = PANEL_COLUMNS as usize;
    let padded = inner.next_multiple_of(kernel.vector());
    packed.par_chunks_mut(padded * PANEL * N).enumerate().for_each(|(p, panel)| {
        let (panel, _) = panel.as_chunks_mut::<N>();
        for column in p * PANEL..columns.min((p + 1) * PANEL) {
            for (k, value) in row(column).iter().enumerate() {
                panel[k * PANEL + column % PANEL] = encode(*value);
            }
        }
    });
}
