use super::{
    Arithmetic, AttentionKernel, Heads, Lanes, Linear, LinearKernel, NearestKernel, Norm, Q8, Tile, Weights,
    packing::{Order, Packing, packed_bytes},
    rows::SLICE,
};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits, Resident, ResidentLayout, Tensor},
};
use std::{
    collections::HashSet,
    ops::{ControlFlow, Index},
    sync::Arc,
};

pub struct ParameterLayout {
    layout: ResidentLayout,
    declared: Vec<Declared>,
    arithmetic: Arithmetic,
    q8: HashSet<String>,
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

impl<F: Fn(&str, &mut [f32]) -> Result<()>> ParameterSource for F {
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()> {
        self(name, out)
    }
}

#[derive(Clone, Copy, Debug)]
pub struct HostParameter(usize);

pub struct Parameters {
    pub resident: Arc<Resident>,
    /// Per declaration; empty for device parameters.
    host: Vec<Vec<f32>>,
}

impl Index<HostParameter> for Parameters {
    type Output = [f32];

    fn index(&self, parameter: HostParameter) -> &[f32] {
        &self.host[parameter.0]
    }
}

pub trait ParameterSource {
    /// Reads values in C order.
    fn read_f32(&self, name: &str, out: &mut [f32]) -> Result<()>;

    /// Reads a weight of [`ParameterLayout::with_q8`].
    fn read_q8(&self, name: &str) -> Result<Q8> {
        unreachable!("{name} has no weights of 8 bits")
    }
}

impl ParameterLayout {
    pub fn new(limits: &Limits, arithmetic: Arithmetic) -> Self {
        Self { layout: ResidentLayout::new(limits), declared: Vec::new(), arithmetic, q8: HashSet::new() }
    }

    /// Keeps these weights in 8 bits. Panics for 8-bit arithmetic.
    pub fn with_q8(self, names: impl IntoIterator<Item = String>) -> Self {
        let q8: HashSet<String> = names.into_iter().collect();
        assert!(q8.is_empty() || !self.arithmetic.has_integers(), "weights of 8 bits are rounded once");
        Self { q8, ..self }
    }

    /// Declares in f32.
    pub fn exactly<T>(&mut self, declare: impl FnOnce(&mut Self) -> T) -> T {
        let exact = self.arithmetic.exact();
        let arithmetic = std::mem::replace(&mut self.arithmetic, exact);
        let declared = declare(self);
        self.arithmetic = arithmetic;
        declared
    }

    pub fn attention(&self, heads: Heads) -> AttentionKernel {
        match self.arithmetic {
            Arithmetic { attention: Some(units), .. } if heads.dim <= Tile::MOST_CHANNELS => {
                AttentionKernel::Matrix(units)
            }
            Arithmetic { element, .. } => AttentionKernel::Lanes(element),
        }
    }

    pub fn nearest(&self) -> NearestKernel {
        self.arithmetic.nearest.map_or(NearestKernel::Lanes, NearestKernel::Matrix)
    }

    pub fn names_and_shapes(self) -> Vec<(String, Vec<usize>)> {
        self.declared.into_iter().map(|parameter| (parameter.name, parameter.shape)).collect()
    }

    pub fn host(&mut self, name: &str, shape: &[usize]) -> HostParameter {
        self.declared.push(Declared { name: name.into(), shape: shape.into(), place: Place::Host });
        HostParameter(self.declared.len() - 1)
    }

    pub fn vector(&mut self, name: &str, shape: &[usize]) -> Tensor {
        self.add::<f32>(name, shape, shape.iter().product(), Packing::Vector)
    }

    /// Declares `NAME.weight` `[columns, inner]` and `NAME.bias`.
    pub fn linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.convolution(name, &[inner], columns)
    }

    pub fn convolution(&mut self, name: &str, kernel: &[usize], columns: usize) -> Linear {
        self.matrix(name, kernel, columns, false, self.arithmetic.without_integers())
    }

    /// 8-bit if available.
    pub fn block_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, false, self.arithmetic)
    }

    pub fn exact_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, false, self.arithmetic.exact())
    }

    pub fn exact_convolution(&mut self, name: &str, kernel: &[usize], columns: usize) -> Linear {
        self.matrix(name, kernel, columns, false, self.arithmetic.exact())
    }

    /// Backward pass in f32, from `[rows, columns]` to `[rows, inner]`.
    pub fn transposed_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.transposed(name, &[columns, inner], 1)
    }

    /// Backward pass, with the kernel flipped.
    pub fn transposed_convolution(&mut self, name: &str, sides: [usize; 2], inputs: usize, outputs: usize) -> Linear {
        self.transposed(name, &[outputs, sides[0], sides[1], inputs], sides[0] * sides[1])
    }

    fn transposed(&mut self, name: &str, shape: &[usize], taps: usize) -> Linear {
        self.reordered(name, shape, [taps * shape[0], shape[shape.len() - 1]], Order::Transposed { taps })
    }

    /// f32, `NAME.weight` `[outputs, inputs, side, side]`, optionally `NAME.bias`. Input rows are
    /// `[side, side, padded inputs]`.
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

    /// Non-overlapping transposed convolution, `NAME.weight` `[inputs, outputs, side, side]`, as an
    /// f32 layer to `[side, side, outputs]`.
    pub fn spread_convolution(&mut self, name: &str, [inputs, outputs]: [usize; 2], side: usize) -> Linear {
        let taps = side * side;
        self.reordered(name, &[inputs, outputs, side, side], [inputs, taps * outputs], Order::Spread { taps })
    }

    fn reordered(&mut self, name: &str, shape: &[usize], [inner, columns]: [usize; 2], order: Order) -> Linear {
        let lanes = Lanes { element: Element::F32, tiles: self.arithmetic.exact_tiles };
        let kernel = LinearKernel::Panels(lanes, Weights::Factors);
        let bias_at = packed_bytes(inner, columns, kernel).next_multiple_of(SLICE);
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

    /// Output [gate | value].
    pub fn gated_linear(&mut self, name: &str, inner: usize, columns: usize) -> Linear {
        self.matrix(name, &[inner], columns, true, self.arithmetic)
    }

    pub fn norm(&mut self, name: &str, width: usize, eps: f32) -> Norm {
        Norm {
            weight: self.vector(&format!("{name}.weight"), &[width]),
            bias: self.vector(&format!("{name}.bias"), &[width]),
            width,
            eps,
        }
    }

    pub fn bytes(&self) -> u64 {
        self.layout.bytes()
    }

    pub fn load(
        &self,
        device: &Device,
        source: &impl ParameterSource,
        mut progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Parameters> {
        let resident = Arc::new(Resident::new(device, &self.layout)?);
        let mut host = vec![Vec::new(); self.declared.len()];
        let (mut values, mut packed) = (Vec::new(), Vec::new());
        let mut done = 0;
        for (Declared { name, shape, place }, host) in self.declared.iter().zip(&mut host) {
            let is_q8 = matches!(place, Place::Device(_, packing) if packing.takes_q8());
            if !is_q8 {
                values.resize(shape.iter().product(), 0.0);
                source.read_f32(name, &mut values)?;
            }
            match place {
                Place::Host => *host = values.clone(),
                Place::Device(tensor, packing) => {
                    if is_q8 {
                        packing.pack_q8(&source.read_q8(name)?, &mut packed);
                    } else {
                        packing.pack(&values, &mut packed);
                    }
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
        let inner = row.iter().product::<usize>();
        let has_q8 = Q8::fits(inner) && self.q8.contains(&format!("{name}.weight"));
        let weights = if has_q8 { Weights::Q8 } else { Weights::Factors };
        let vectors = columns.is_multiple_of(if gated { 8 } else { 4 });
        let kernel = match arithmetic {
            Arithmetic { quantized: Some(units), .. } if vectors => LinearKernel::Matrix(units, weights),
            Arithmetic { dots: Some(tiles), .. } if vectors => LinearKernel::Dots(tiles),
            Arithmetic { linear: Some(units), .. } if vectors => LinearKernel::Matrix(units, weights),
            Arithmetic { element, tiles, .. } => LinearKernel::Panels(Lanes { element, tiles }, weights),
        };
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
