//! A model's parameters on the device: laid out from shapes alone, then loaded from a checkpoint.

use super::{Arithmetic, AttentionKernel, Linear, LinearKernel, NearestKernel, Norm, Units, linear::scales_at};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Resident, ResidentLayout, Tensor},
    kernels::limits::PANEL_COLUMNS,
};
use rayon::prelude::*;
use std::{
    ops::{ControlFlow, Index},
    sync::Arc,
};

/// The parameters of a network: name, shape, where each goes and how it is packed there. What declares a parameter here is the
/// only place that names it: checkpoints are checked against what was declared.
pub struct ParameterLayout {
    layout: ResidentLayout,
    declared: Vec<Declared>,
    arithmetic: Arithmetic,
}

struct Declared {
    name: String,
    shape: Vec<usize>,
    place: Place,
}

enum Place {
    Device(Tensor, Packing),
    Host,
}

/// A parameter that the host keeps.
#[derive(Clone, Copy, Debug)]
pub struct HostParameter(usize);

/// The values of all parameters.
pub struct Parameters {
    /// The parameters on the device.
    pub resident: Arc<Resident>,
    /// The values of each that was declared for the host; nothing of the others.
    host: Vec<Vec<f32>>,
}

impl Index<HostParameter> for Parameters {
    type Output = [f32];

    fn index(&self, parameter: HostParameter) -> &[f32] {
        &self.host[parameter.0]
    }
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
    /// A matrix whose values the checkpoint has in another order, as [`LinearKernel`] wants it, and behind it, from a multiple of 256
    /// bytes on, a bias `[columns]` of zeros.
    Reordered { order: Order, inner: usize, columns: usize, kernel: LinearKernel },
}

/// The order of a checkpoint's values of a matrix `[columns, inner]`.
#[derive(Clone, Copy)]
enum Order {
    /// `[inner / taps, taps, columns]`, the taps from last to first: a convolution, for gradients.
    Transposed { taps: usize },
    /// `[columns, channels, taps]` for an inner `[taps, channels padded to whole vec4]`: a convolution of pictures whose channels run
    /// fastest.
    Planar { taps: usize, channels: usize },
    /// `[inner, columns / taps, taps]` for columns `[taps, columns / taps]`: a transposed convolution whose kernels do not overlap.
    Spread { taps: usize },
}

impl Order {
    /// The place in the checkpoint of the value in a column; nothing for padding.
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

/// Row of a checkpoint's matrix that is column `column` of the packed one: of a gated one the first and second half
/// alternate, gate, value, gate, value.
fn source_row(column: usize, columns: usize, gated: bool) -> usize {
    if gated { (column % 2) * (columns / 2) + column / 2 } else { column }
}

impl ParameterLayout {
    /// An empty layout for devices of these limits.
    pub fn new(limits: &Limits, arithmetic: Arithmetic) -> Self {
        Self { layout: ResidentLayout::new(limits), declared: Vec::new(), arithmetic }
    }

    /// The kernel of attention.
    pub fn attention(&self) -> AttentionKernel {
        match self.arithmetic {
            Arithmetic { attention: Some(units), .. } => AttentionKernel::Matrix(units),
            Arithmetic { element, .. } => AttentionKernel::Lanes(element),
        }
    }

    /// The kernel that finds nearest rows.
    pub fn nearest(&self) -> NearestKernel {
        self.arithmetic.nearest.map_or(NearestKernel::Lanes, NearestKernel::Matrix)
    }

    /// Name and shape of every parameter, in the order in which they were declared.
    pub fn names_and_shapes(self) -> Vec<(String, Vec<usize>)> {
        self.declared.into_iter().map(|parameter| (parameter.name, parameter.shape)).collect()
    }

    /// A parameter that the host reads; it takes no memory on the device.
    pub fn host(&mut self, name: &str, shape: &[usize]) -> HostParameter {
        self.declared.push(Declared { name: name.into(), shape: shape.into(), place: Place::Host });
        HostParameter(self.declared.len() - 1)
    }

    /// A parameter as it is.
    pub fn vector(&mut self, name: &str, shape: &[usize]) -> Tensor {
        self.add::<f32>(name, shape, shape.iter().product(), Packing::Vector)
    }

    /// `NAME.weight` `[columns, inner]` and `NAME.bias`.
    pub fn linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.convolution(name, &[inner], columns)
    }

    /// As [`ParameterLayout::linear`], for a convolution whose kernel is a row of the weight.
    pub fn convolution(&mut self, name: &str, kernel: &[usize], columns: usize) -> Linear {
        self.matrix(name, kernel, columns, false, Arithmetic { quantised: None, ..self.arithmetic })
    }

    /// As [`ParameterLayout::linear`], within a block, whose errors the residual stream outweighs: 8-bit integers where the
    /// arithmetic has them.
    pub fn block_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, false, self.arithmetic)
    }

    /// As [`ParameterLayout::linear`], in f32 whatever the arithmetic: for what f16 cannot hold and costs nothing.
    pub fn exact_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, false, Arithmetic::EXACT)
    }

    /// As [`ParameterLayout::convolution`], in f32 whatever the arithmetic.
    pub fn exact_convolution(&mut self, name: &str, kernel: &[usize], columns: usize) -> Linear {
        self.matrix(name, kernel, columns, false, Arithmetic::EXACT)
    }

    /// The layer from gradients by the results of the layer `name`, `[rows, columns]`, to those by its inputs, `[rows, inner]`:
    /// its weight transposed, without bias, in f32 whatever the arithmetic.
    pub fn transposed_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.transposed(name, &[columns, inner], 1)
    }

    /// As [`ParameterLayout::transposed_linear`], for a convolution of `inputs` channels with a kernel of these sides: a
    /// convolution of gradients with the kernel turned round.
    pub fn transposed_convolution(&mut self, name: &str, sides: [usize; 2], inputs: usize, outputs: usize) -> Linear {
        self.transposed(name, &[outputs, sides[0], sides[1], inputs], sides[0] * sides[1])
    }

    /// The weight `NAME.weight` `[outputs, .., inputs]`, of so many taps, from outputs to inputs.
    fn transposed(&mut self, name: &str, shape: &[usize], taps: usize) -> Linear {
        self.reordered(name, shape, [taps * shape[0], shape[shape.len() - 1]], Order::Transposed { taps })
    }

    /// `NAME.weight` `[outputs, inputs, side, side]` and, where `biased`, `NAME.bias` of a convolution whose rows are `[side, side,
    /// inputs padded to whole vec4]`, in f32 whatever the arithmetic.
    pub fn planar_convolution(
        &mut self,
        name: &str,
        [inputs, outputs]: [usize; 2],
        side: usize,
        biased: bool,
    ) -> Linear {
        let taps = side * side;
        let inner = taps * inputs.next_multiple_of(4);
        let order = Order::Planar { taps, channels: inputs };
        let layer = self.reordered(name, &[outputs, inputs, side, side], [inner, outputs], order);
        if biased { Linear { bias: self.vector(&format!("{name}.bias"), &[outputs]), ..layer } } else { layer }
    }

    /// `NAME.weight` `[inputs, outputs, side, side]` of a transposed convolution whose kernels do not overlap: a layer to
    /// `[side, side, outputs]` without bias, in f32 whatever the arithmetic.
    pub fn spread_convolution(&mut self, name: &str, [inputs, outputs]: [usize; 2], side: usize) -> Linear {
        let taps = side * side;
        self.reordered(name, &[inputs, outputs, side, side], [inputs, taps * outputs], Order::Spread { taps })
    }

    fn reordered(&mut self, name: &str, shape: &[usize], [inner, columns]: [usize; 2], order: Order) -> Linear {
        let kernel = LinearKernel::Panels(Element::F32);
        let bias_at = packed_bytes(inner, columns, kernel).next_multiple_of(256);
        let packing = Packing::Reordered { order, inner, columns, kernel };
        let both = self.add::<u8>(&format!("{name}.weight"), shape, bias_at + size_of::<f32>() * columns, packing);
        Linear {
            weight: both.slice::<u8>(0, bias_at),
            bias: both.slice::<f32>(bias_at / size_of::<f32>(), columns),
            inner: inner.next_multiple_of(kernel.vector()),
            columns,
            kernel,
        }
    }

    /// As [`ParameterLayout::block_linear`] for a layer whose output is [gate | value].
    pub fn gated_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, true, self.arithmetic)
    }

    /// `NAME.weight` and `NAME.bias` of a layer norm.
    pub fn norm(&mut self, name: &str, width: usize, eps: f32) -> Norm {
        Norm {
            weight: self.vector(&format!("{name}.weight"), &[width]),
            bias: self.vector(&format!("{name}.bias"), &[width]),
            width,
            eps,
        }
    }

    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        self.layout.bytes()
    }

    /// Allocates the parameters and loads them one by one. `read` fills in the values of a name, in C order; `progress` gets the
    /// share that is done and may stop it.
    ///
    /// # Errors
    /// [`Error::Memory`] where the device has too little; the error of `read`; [`Error::Cancelled`].
    pub fn load(
        &self,
        device: &Device,
        mut read: impl FnMut(&str, &mut [f32]) -> Result<()>,
        mut progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Parameters> {
        let resident = Arc::new(Resident::new(device, &self.layout)?);
        let mut host = vec![Vec::new(); self.declared.len()];
        let (mut source, mut packed) = (Vec::new(), Vec::new());
        let mut done = 0;
        for (Declared { name, shape, place }, host) in self.declared.iter().zip(&mut host) {
            source.resize(shape.iter().product(), 0.0);
            read(name, &mut source)?;
            match place {
                Place::Host => *host = source.clone(),
                Place::Device(tensor, packing) => {
                    packing.pack(&source, &mut packed);
                    resident.write(*tensor, &packed)?;
                    done += tensor.bytes();
                }
            }
            if progress(done as f64 / self.bytes() as f64).is_break() {
                return Err(Error::Cancelled);
            }
        }
        Ok(Parameters { resident, host })
    }

    fn matrix(&mut self, name: &str, row: &[usize], columns: usize, gated: bool, arithmetic: Arithmetic) -> Linear {
        // The matrix kernel writes whole vectors.
        let Arithmetic { element, linear, quantised, .. } = arithmetic;
        let kernel = match quantised.or(linear) {
            Some(units) if columns.is_multiple_of(if gated { 8 } else { 4 }) => LinearKernel::Matrix(units),
            _ => LinearKernel::Panels(element),
        };
        let inner = row.iter().product::<usize>();
        let (packing, shape) = (Packing::Matrix { inner, columns, gated, kernel }, [&[columns], row].concat());
        let bias = if gated { Packing::GatedVector } else { Packing::Vector };
        Linear {
            weight: self.add::<u8>(&format!("{name}.weight"), &shape, packed_bytes(inner, columns, kernel), packing),
            bias: self.add::<f32>(&format!("{name}.bias"), &[columns], columns, bias),
            inner: inner.next_multiple_of(kernel.vector()),
            columns,
            kernel,
        }
    }

    fn add<T>(&mut self, name: &str, shape: &[usize], len: usize, packing: Packing) -> Tensor {
        let tensor = self.layout.add::<T>(len);
        let place = Place::Device(tensor, packing);
        self.declared.push(Declared { name: name.into(), shape: shape.into(), place });
        tensor
    }
}

/// Bytes of a packed matrix.
fn packed_bytes(inner: usize, columns: usize, kernel: LinearKernel) -> usize {
    let inner = inner.next_multiple_of(kernel.vector());
    match kernel {
        LinearKernel::Panels(element) => element.bytes() * inner * columns.next_multiple_of(PANEL_COLUMNS as usize),
        LinearKernel::Matrix(Units { factor: Element::I8, .. }) => scales_at(columns, inner) + 4 * columns,
        LinearKernel::Matrix(Units { factor, .. }) => factor.bytes() * inner * columns,
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
            Packing::Reordered { order, inner, columns, kernel } => {
                let value = |c, k| order.place([inner, columns], c, k).map_or(0.0, |place| source[place]);
                let matrix: Vec<f32> = (0..columns).flat_map(|c| (0..inner).map(move |k| value(c, k))).collect();
                Packing::Matrix { inner, columns, gated: false, kernel }.pack(&matrix, packed);
                packed.resize(packed.len().next_multiple_of(256) + size_of::<f32>() * columns, 0);
            }
            Packing::Matrix { inner, columns, gated, kernel } => {
                packed.resize(packed_bytes(inner, columns, kernel), 0);
                let row = |column: usize| &source[source_row(column, columns, gated) * inner..][..inner];
                let padded = inner.next_multiple_of(kernel.vector());
                match kernel {
                    LinearKernel::Panels(Element::F32) => panels::<4>(row, columns, padded, Element::F32, packed),
                    LinearKernel::Panels(half) => panels::<2>(row, columns, padded, half, packed),
                    LinearKernel::Matrix(Units { factor: Element::I8, .. }) => quantised(row, columns, padded, packed),
                    LinearKernel::Matrix(Units { factor, .. }) => {
                        packed.par_chunks_mut(factor.bytes() * padded).enumerate().for_each(|(column, out)| {
                            out[..factor.bytes() * inner].copy_from_slice(&factor.encode(row(column)));
                        });
                    }
                }
            }
        }
    }
}

/// The bytes of the matrix `weight` `[columns, inner]` as `kernel` reads them.
pub fn pack_matrix(kernel: LinearKernel, weight: &[f32], inner: usize, columns: usize) -> Vec<u8> {
    let mut packed = Vec::new();
    Packing::Matrix { inner, columns, gated: false, kernel }.pack(weight, &mut packed);
    packed
}

/// Columns, each a row of a checkpoint's matrix, as `[panels, padded, PANEL_COLUMNS]` of a type of N bytes.
fn panels<'a, const N: usize>(
    row: impl Fn(usize) -> &'a [f32] + Sync,
    columns: usize,
    padded: usize,
    element: Element,
    packed: &mut [u8],
) {
    const PANEL: usize = PANEL_COLUMNS as usize;
    packed.par_chunks_mut(padded * PANEL * N).enumerate().for_each(|(p, panel)| {
        let (panel, _) = panel.as_chunks_mut::<N>();
        for column in p * PANEL..columns.min((p + 1) * PANEL) {
            for (k, value) in element.encode(row(column)).as_chunks::<N>().0.iter().enumerate() {
                panel[k * PANEL + column % PANEL] = *value;
            }
        }
    });
}

/// Columns as 8-bit integers `[columns, padded]`, each with a scale that makes its largest magnitude 127, and behind them
/// the scales.
fn quantised<'a>(row: impl Fn(usize) -> &'a [f32] + Sync, columns: usize, padded: usize, packed: &mut [u8]) {
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
