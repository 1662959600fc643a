use super::{Lanes, LinearKernel, Units, Weights, linear::scales_at, q8::Q8, rows::SLICE};
use crate::{gpu::Element, kernels::limits::PANEL_COLUMNS, kernels::limits::Q8_GROUP};
use half::f16;
use rayon::prelude::*;

const PANEL: usize = PANEL_COLUMNS as usize;
const GROUP: usize = Q8_GROUP as usize;

#[derive(Clone, Copy)]
pub(super) enum Packing {
    /// Unchanged values.
    Vector,
    /// A vector for a gated matrix.
    GatedVector,
    /// A zero-padded `[columns, inner]` matrix.
    Matrix { inner: usize, columns: usize, gated: bool, kernel: LinearKernel },
    /// A permuted matrix, then a zero bias `[columns]` at a 256-byte boundary.
    Reordered { order: Order, inner: usize, columns: usize, kernel: LinearKernel },
}

#[derive(Clone, Copy)]
pub(super) enum Order {
    /// `[inner / taps, taps, columns]`, taps reversed: a convolution's gradient.
    Transposed { taps: usize },
    /// `[columns, channels, taps]` to channels-last `[taps, padded channels]`.
    Planar { taps: usize, channels: usize },
    /// `[inner, columns / taps, taps]` to `[taps, columns / taps]`: a non-overlapping transposed
    /// convolution.
    Spread { taps: usize },
}

impl Order {
    /// Source index; `None` for padding.
    fn place(self, [inner, columns]: [usize; 2], column: usize, k: usize) -> Option<usize> {
        match self {
            Order::Transposed { taps } => {
                let outputs = inner / taps;
                Some((k % outputs * taps + taps - 1 - k / outputs) * columns + column)
            }
            Order::Planar { taps, channels } => {
                let (tap, channel) = (k / (inner / taps), k % (inner / taps));
                (channel < channels).then_some((column * channels + channel) * taps + tap)
            }
            Order::Spread { taps } => {
                let outputs = columns / taps;
                Some((k * outputs + column % outputs) * taps + column / outputs)
            }
        }
    }
}

/// Source row; gated matrices interleave gate and value.
fn source_row(column: usize, columns: usize, gated: bool) -> usize {
    if gated { (column % 2) * (columns / 2) + column / 2 } else { column }
}

pub(super) fn packed_bytes(inner: usize, columns: usize, kernel: LinearKernel) -> usize {
    let inner = inner.next_multiple_of(kernel.vector());
    let padded = kernel.padded_columns(columns);
    match kernel {
        LinearKernel::Panels(_, Weights::Q8) | LinearKernel::Matrix(_, Weights::Q8) => {
            scales_at(padded, inner) + size_of::<f16>() * padded * inner / GROUP
        }
        LinearKernel::Matrix(Units { factor: Element::I8, .. }, _) | LinearKernel::Dots(_) => {
            scales_at(columns, inner) + 4 * columns
        }
        LinearKernel::Panels(..) | LinearKernel::Matrix(..) => kernel.factor().bytes() * inner * padded,
    }
}

impl Packing {
    pub fn takes_q8(self) -> bool {
        matches!(self, Packing::Matrix { kernel, .. } if kernel.weights() == Weights::Q8)
    }

    pub fn pack(self, source: &[f32], packed: &mut Vec<u8>) {
        packed.clear();
        match self {
            Packing::Vector => packed.extend_from_slice(bytemuck::cast_slice(source)),
            Packing::GatedVector => {
                let value = |column| source[source_row(column, source.len(), true)];
                packed.extend((0..source.len()).flat_map(|column| value(column).to_ne_bytes()));
            }
            Packing::Reordered { order, inner, columns, kernel } => {
                let value = |c, k| order.place([inner, columns], c, k).map_or(0.0, |place| source[place]);
                let matrix: Vec<f32> = (0..columns).flat_map(|c| (0..inner).map(move |k| value(c, k))).collect();
                Packing::Matrix { inner, columns, gated: false, kernel }.pack(&matrix, packed);
                packed.resize(packed.len().next_multiple_of(SLICE) + size_of::<f32>() * columns, 0);
            }
            Packing::Matrix { inner, columns, gated, kernel } => {
                packed.resize(packed_bytes(inner, columns, kernel), 0);
                let row = |column: usize| &source[source_row(column, columns, gated) * inner..][..inner];
                let padded = inner.next_multiple_of(kernel.vector());
                match kernel {
                    LinearKernel::Panels(_, Weights::Q8) | LinearKernel::Matrix(_, Weights::Q8) => {
                        panic!("weights of 8 bits come as such")
                    }
                    LinearKernel::Panels(Lanes { element: Element::F32, .. }, _) => {
                        panels::<4>(row, columns, padded, Element::F32, packed);
                    }
                    LinearKernel::Panels(Lanes { element: half, .. }, _) => {
                        panels::<2>(row, columns, padded, half, packed);
                    }
                    LinearKernel::Matrix(Units { factor: Element::I8, .. }, _) | LinearKernel::Dots(_) => {
                        quantized(row, columns, padded, packed);
                    }
                    LinearKernel::Matrix(Units { factor, .. }, _) => {
                        packed.par_chunks_mut(factor.bytes() * padded).enumerate().for_each(|(column, out)| {
                            out[..factor.bytes() * inner].copy_from_slice(&factor.encode(row(column)));
                        });
                    }
                }
            }
        }
    }

    pub fn pack_q8(self, source: &Q8, packed: &mut Vec<u8>) {
        let Packing::Matrix { inner, columns, gated, kernel } = self else { panic!("a matrix") };
        packed.clear();
        packed.resize(packed_bytes(inner, columns, kernel), 0);
        let (integers, scales) = packed.split_at_mut(scales_at(kernel.padded_columns(columns), inner));
        let row = |column: usize| source_row(column, columns, gated);
        let integers_of = |column: usize| &source.integers[row(column) * inner..][..inner];
        let groups = inner / GROUP;
        let scales_of = |column: usize| &source.scales[row(column) * groups..][..groups];
        match kernel {
            LinearKernel::Panels(..) => {
                let panels = integers.par_chunks_mut(PANEL * inner).zip(scales.par_chunks_mut(2 * PANEL * groups));
                panels.enumerate().for_each(|(p, (integers, scales))| {
                    for c in 0..PANEL.min(columns.saturating_sub(p * PANEL)) {
                        for (k, &integer) in integers_of(p * PANEL + c).iter().enumerate() {
                            let quad = k / 4 * (PANEL / 4) + c / 4;
                            integers[(quad * 4 + k % 4) * 4 + c % 4] = integer as u8;
                        }
                        for (g, scale) in scales_of(p * PANEL + c).iter().enumerate() {
                            scales[2 * (g * PANEL + c)..][..2].copy_from_slice(&scale.to_ne_bytes());
                        }
                    }
                });
            }
            LinearKernel::Matrix(..) | LinearKernel::Dots(_) => {
                let columns = integers.par_chunks_mut(inner).zip(scales.par_chunks_mut(2 * groups)).take(columns);
                columns.enumerate().for_each(|(column, (integers, scales))| {
                    integers.copy_from_slice(bytemuck::cast_slice(integers_of(column)));
                    scales.copy_from_slice(bytemuck::cast_slice(scales_of(column)));
                });
            }
        }
    }
}

/// Packs `weight` `[columns, inner]` for `kernel`. Panics if values exceed a required [`Q8`].
pub fn pack_matrix(kernel: LinearKernel, weight: &[f32], inner: usize, columns: usize) -> Vec<u8> {
    let mut packed = Vec::new();
    let packing = Packing::Matrix { inner, columns, gated: false, kernel };
    match kernel.weights() {
        Weights::Q8 => packing.pack_q8(&Q8::round(weight).expect("weights within f16"), &mut packed),
        Weights::Factors => packing.pack(weight, &mut packed),
    }
    packed
}

fn panels<'a, const N: usize>(
    row: impl Fn(usize) -> &'a [f32] + Sync,
    columns: usize,
    padded: usize,
    element: Element,
    packed: &mut [u8],
) {
    packed.par_chunks_mut(padded * PANEL * N).enumerate().for_each(|(p, panel)| {
        let (panel, _) = panel.as_chunks_mut::<N>();
        for column in p * PANEL..columns.min((p + 1) * PANEL) {
            for (k, value) in element.encode(row(column)).as_chunks::<N>().0.iter().enumerate() {
                panel[k * PANEL + column % PANEL] = *value;
            }
        }
    });
}

/// 8-bit integers `[columns, padded]` with largest magnitude 127, then scales.
fn quantized<'a>(row: impl Fn(usize) -> &'a [f32] + Sync, columns: usize, padded: usize, packed: &mut [u8]) {
    let largest = |column: usize| row(column).iter().fold(0f32, |most, x| most.max(x.abs()));
    let (integers, scales) = packed.split_at_mut(scales_at(columns, padded));
    integers[..columns * padded].par_chunks_mut(padded).enumerate().for_each(|(column, out)| {
        let steps = 127.0 / largest(column).max(f32::MIN_POSITIVE);
        let scaled: Vec<f32> = row(column).iter().map(|x| x * steps).collect();
        out[..scaled.len()].copy_from_slice(&Element::I8.encode(&scaled));
    });
    for (column, scale) in scales.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        *scale = (largest(column) / 127.0).to_ne_bytes();
    }
}
