mod cases;
mod faults;
mod held;
mod q8;

pub use cases::{area, shapes};
pub use q8::{q8_area, q8_shapes};

use crate::{case, prelude::*, trial::UNWRITTEN};
use faults::Fault;
use held::Held;
use rayon::prelude::*;
use zipsplat::ops::{Activation, Epilogue, Linear, LinearKernel, Q8, Weights, pack_matrix};
use zipsplat_reference::ops::activation::{gelu, sigmoid, silu};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Residual {
    None,
    /// Tensor of its own.
    Apart,
    /// The output.
    InPlace,
}

#[derive(Clone)]
pub struct Problem {
    rows: usize,
    inner: usize,
    columns: usize,
    /// `[rows, inner]`.
    pub x: Vec<f32>,
    /// `[columns, inner]`
    pub weight: Vec<f32>,
    bias: Vec<f32>,
    /// SwiGLU takes columns [gate | value].
    pub activation: Activation,
    pub scaled: bool,
    pub residual: Residual,
    /// In the factors' type instead of f32.
    pub stored: bool,
    pub limits: fn(&mut Limits),
    /// All partial sums are exact in f32, in any order.
    whole: bool,
    /// Every type represents the factors exactly.
    held: bool,
}

/// `[rows, out_columns]`, and factors as on the device.
pub(crate) struct Truth {
    values: Vec<f64>,
    errors: Vec<f64>,
    held: Held,
    sums: Vec<f64>,
}

struct Sum {
    value: f64,
    error: f64,
}

impl Problem {
    pub fn random(rows: usize, inner: usize, columns: usize) -> Self {
        let mut noise = Noise::new((rows * 31 + inner * 7 + columns) as u64);
        let (x, weight, bias) = (noise.values(rows * inner), noise.values(columns * inner), noise.values(columns));
        Self {
            rows,
            inner,
            columns,
            x,
            weight,
            bias,
            activation: Activation::None,
            scaled: false,
            residual: Residual::None,
            stored: false,
            limits: |_| (),
            whole: false,
            held: false,
        }
    }

    /// Every type holds the factors exactly: multiples of 1/128, with the largest first in each
    /// group of 8-bit weights. Short sums are exact, too.
    pub fn exact(rows: usize, inner: usize, columns: usize) -> Self {
        let mut problem = Self { whole: inner <= 1024, held: true, ..Self::random(rows, inner, columns) };
        for row in problem.x.chunks_mut(inner).chain(problem.weight.chunks_mut(inner)) {
            for (k, x) in row.iter_mut().enumerate() {
                *x = if k % Q8::GROUP == 0 { 127.0 } else { (126.0 * *x).round() } / 128.0;
            }
        }
        problem.bias.iter_mut().for_each(|b| *b = (*b * 128.0).round() / 128.0);
        problem
    }

    fn gamma(&self) -> Vec<f32> {
        if self.scaled { Noise::new(71).values(self.out_columns()) } else { vec![1.0; self.out_columns()] }
    }

    fn stream(&self) -> Vec<f32> {
        let len = self.rows * self.out_columns();
        if self.residual == Residual::None { vec![0.0; len] } else { Noise::new(72).values(len) }
    }

    fn out_columns(&self) -> usize {
        if self.activation == Activation::SwiGlu { self.columns / 2 } else { self.columns }
    }

    /// Results are whole vectors, as matrix units and dot products write them.
    fn has_vectors(&self) -> bool {
        self.out_columns().is_multiple_of(4)
    }

    fn factor(&self, mode: Mode) -> Element {
        match mode.factor {
            Element::I8 if !self.has_vectors() => Element::F16,
            factor => factor,
        }
    }

    /// Type of a stored result.
    fn element(&self, mode: Mode) -> Element {
        match self.factor(mode) {
            _ if !self.stored => Element::F32,
            Element::I8 => Element::F16,
            factor => factor,
        }
    }

    fn kernel(&self, device: &Device, mode: Mode) -> LinearKernel {
        match mode.units(device).filter(|_| self.has_vectors()) {
            Some(units) => LinearKernel::Matrix(units, mode.weights),
            None => mode.on_lanes(self.factor(mode)),
        }
    }

    /// Relative error of an expanded 8-bit weight. f16 may round either way; bf16 rounds to
    /// nearest.
    fn expanding(&self, mode: Mode) -> f64 {
        let becomes_factor = mode.weights == Weights::Q8 && mode.matrix && self.has_vectors();
        match mode.factor {
            Element::F16 if becomes_factor => 2.0 * Element::F16.roundoff(),
            Element::Bf16 if becomes_factor => Element::Bf16.roundoff(),
            _ => 0.0,
        }
    }

    fn sum(&self, held: &Held, mode: Mode, row: usize, column: usize) -> Sum {
        let (x, w) = (&held.x[row * self.inner..][..self.inner], &held.weight[column * self.inner..][..self.inner]);
        let bias = f64::from(self.bias[column]);
        // Subnormal factors may be flushed.
        let least = mode.factors().tiny.max(TINY);
        let is_tiny = |x: f64| x != 0.0 && x.abs() < least;
        let (mut value, mut size, mut lost, mut terms) = (0.0, 0.0, 0.0, 0);
        for &k in &held.channels[row] {
            let product = x[k] * w[k];
            if product != 0.0 {
                (value, size, terms) = (value + product, size + product.abs(), terms + 1);
                if is_tiny(x[k]) || is_tiny(w[k]) {
                    lost += product.abs();
                }
            }
        }
        let error = match self.factor(mode) {
            // The integer sum is exact. Its f32 conversion is scaled twice, with one device
            // division, before the bias.
            Element::I8 => {
                let moved = held.moves[row].iter().map(|&(k, by)| by * w[k].abs()).sum::<f64>();
                gamma(10) * (value.abs() + moved + bias.abs()) + moved
            }
            _ if self.whole => 0.0,
            _ => {
                let expanded = self.expanding(mode) * size;
                mode.factors().sum(terms + 1) * (size + expanded + bias.abs())
                    + expanded
                    + lost
                    + (terms + 1) as f64 * TINY
            }
        };
        Sum { value: value + bias, error }
    }

    fn finish(&self, sums: &[f64]) -> Vec<f64> {
        let values: Vec<f64> = match self.activation {
            Activation::None => sums.to_vec(),
            Activation::Gelu => sums.iter().map(|&z| gelu(z)).collect(),
            Activation::SwiGlu => self.gated(sums, |gate, value| silu(gate) * value),
        };
        self.added(&values, |value, gamma, residual| value * gamma + residual)
    }

    fn gated<T: Copy, R>(&self, sums: &[T], function: impl Fn(T, T) -> R) -> Vec<R> {
        let half = self.columns / 2;
        let rows = sums.chunks(self.columns.max(1));
        rows.flat_map(|row| (0..half).map(|j| function(row[j], row[half + j])).collect::<Vec<_>>()).collect()
    }

    fn added(&self, values: &[f64], function: impl Fn(f64, f64, f64) -> f64) -> Vec<f64> {
        let (gamma, stream) = (self.gamma(), self.stream());
        let one = |(i, &value): (usize, &f64)| function(value, gamma[i % gamma.len()].into(), stream[i].into());
        values.iter().enumerate().map(one).collect()
    }

    fn errors(&self, sums: &[Sum], finished: &[f64], element: Element) -> Vec<f64> {
        let mut errors: Vec<f64> = match self.activation {
            Activation::None => sums.iter().map(|sum| sum.error).collect(),
            Activation::Gelu => sums.iter().map(|sum| gelu_error(sum.value, sum.error)).collect(),
            Activation::SwiGlu => {
                let places: Vec<usize> = (0..sums.len()).collect();
                self.gated(&places, |gate, value| swiglu_error(&sums[gate], &sums[value]))
            }
        };
        if self.scaled || self.residual != Residual::None {
            let (gamma, stream) = (self.gamma(), self.stream());
            for (i, error) in errors.iter_mut().enumerate() {
                let carried = *error * f64::from(gamma[i % gamma.len()]).abs();
                let scaled = finished[i] - f64::from(stream[i]);
                *error = carried + 2.0 * U * (scaled.abs() + finished[i].abs() + carried) + TINY;
            }
        }
        let stored = Mode { factor: element, ..Mode::EXACT };
        errors.iter().zip(finished).map(|(error, value)| stored.stored(*value, *error)).collect()
    }

    /// A row past the end that kernels must not write.
    fn guard(&self) -> usize {
        self.out_columns()
    }

    /// Returns a result, followed by the guard.
    pub fn run(&self, device: &Device, kernel: LinearKernel, output: Element) -> Result<Vec<f32>> {
        let mut trial = Trial::changed(device, self.limits);
        // SwiGLU gates and values interleave on the device.
        let source = |column: usize| match self.activation {
            Activation::SwiGlu => column % 2 * (self.columns / 2) + column / 2,
            _ => column,
        };
        let rows = (0..self.columns).flat_map(|c| &self.weight[source(c) * self.inner..][..self.inner]);
        let packed = pack_matrix(kernel, &rows.copied().collect::<Vec<_>>(), self.inner, self.columns);
        let bias: Vec<f32> = (0..self.columns).map(|c| self.bias[source(c)]).collect();
        let layer = Linear {
            weight: trial.input(&packed),
            bias: trial.input(&bias),
            inner: self.inner.next_multiple_of(kernel.vector()),
            columns: self.columns,
            kernel,
        };
        let padding = vec![0.0; layer.inner - self.inner];
        let rows: Vec<f32> = self.x.chunks(self.inner).flat_map(|row| [row, &padding].concat()).collect();
        let element = kernel.element();
        let input = Rows { tensor: trial.input_of(element, &rows), count: self.rows, width: layer.inner, element };
        let out_rows = |tensor, element| Rows { tensor, count: self.rows, width: self.out_columns(), element };
        let guard = vec![f32::from_bits(UNWRITTEN); self.guard()];
        let output_of = |trial: &mut Trial<'_>| trial.output_of(output, self.rows * self.out_columns() + self.guard());
        let (residual, out) = match self.residual {
            Residual::None => (None, output_of(&mut trial)),
            Residual::Apart => (Some(trial.input(&self.stream())), output_of(&mut trial)),
            Residual::InPlace => {
                let target = trial.input(&[self.stream(), guard].concat());
                trial.rec.output(target);
                (Some(target), target)
            }
        };
        let epilogue = Epilogue {
            activation: self.activation,
            gamma: self.scaled.then(|| trial.input(&self.gamma())),
            residual: residual.map(|tensor| out_rows(tensor, Element::F32)),
        };
        layer.record(&mut trial.rec, input, out_rows(out, output), epilogue);
        trial.result_of(output, out)
    }

    fn guarded(&self, values: Vec<f64>) -> Vec<f32> {
        let values = values.into_iter().map(|x| x as f32);
        values.chain(vec![f32::from_bits(UNWRITTEN); self.guard()]).collect()
    }
}

impl case::Problem for Problem {
    type Output = Vec<f32>;
    type Truth = Truth;
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        self.run(device, self.kernel(device, mode), self.element(mode))
    }

    fn truth(&self, mode: Mode) -> Truth {
        let held = Held::new(self, mode, f64::round_ties_even);
        let row = |row: usize| (0..self.columns).map(move |column| (row, column));
        let places: Vec<_> = (0..self.rows).flat_map(row).collect();
        let sums: Vec<Sum> = places.into_par_iter().map(|(row, column)| self.sum(&held, mode, row, column)).collect();
        let plain: Vec<f64> = sums.iter().map(|sum| sum.value).collect();
        let values = self.finish(&plain);
        Truth { errors: self.errors(&sums, &values, self.element(mode)), values, held, sums: plain }
    }

    fn judge(&self, truth: &Truth, output: &Vec<f32>, _: Mode) -> Worst {
        let (got, guard) = output.split_at(truth.values.len());
        let written: Vec<bool> = guard.iter().map(|x| !x.is_nan()).collect();
        Worst::of(got, &truth.values, |i| truth.errors[i]).or(Worst::differing(&written, &vec![false; self.guard()]))
    }

    fn typical(&self, device: &Device, mode: Mode) -> Tolerance {
        let sums = Tolerance::sum_of(self.inner).and(Tolerance::ELEMENTWISE);
        let sums = match self.kernel(device, mode) {
            // Integers of random inputs may lie on ties, and their scales round.
            _ if !self.held && (mode.factor == Element::I8 || mode.weights == Weights::Q8) => return Tolerance::ANY,
            LinearKernel::Matrix(units, _) if !device.limits().cpu => {
                sums.and(Tolerance::sum_cut_off(self.inner.div_ceil(units.shape.k as usize)))
            }
            _ => sums,
        };
        let sums = if self.activation == Activation::SwiGlu { sums.times(2.0) } else { sums };
        sums.stored_in(self.element(mode))
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Vec<f32>> {
        match fault {
            Fault::PastEnd => vec![vec![0.0; truth.values.len() + self.guard()]],
            _ => self.wrong(truth, fault, mode).into_iter().map(|values| self.guarded(values)).collect(),
        }
    }

    fn zeros(&self, truth: &Truth) -> Option<Vec<f32>> {
        Some(self.guarded(vec![0.0; truth.values.len()]))
    }
}

/// GELU's slope is at most 1.13, and `shared/gelu.glsl` fits erf to 1.2e-7.
pub(crate) fn gelu_error(z: f64, error: f64) -> f64 {
    let t = z.abs() * std::f64::consts::FRAC_1_SQRT_2;
    let decayed = (-t * t).exp();
    let from_exp = if t < 1.0 { 0.0 } else { exponential(t * t) * decayed * 0.43 };
    let from_argument = 2.0 * U * t * 1.13 * decayed;
    let own = 0.5 * z.abs() * (1.2e-7 + from_exp + from_argument) + 3.0 * U * z.abs().min(gelu(z).abs() + 1.0);
    1.13 * error + own + TINY
}

/// SiLU's slope is at most 1.1.
fn swiglu_error(gate: &Sum, value: &Sum) -> f64 {
    let silu = silu(gate.value);
    let own = silu.abs() * ((1.0 - sigmoid(gate.value)) * exponential(gate.value) + DIVISION + ULP);
    // 1 + exp(-gate) above 2^126 may divide to zero.
    let silu_error = 1.1 * gate.error + own + gate.value.abs() * TINY;
    let carried = silu_error * (value.value.abs() + value.error) + silu.abs() * value.error;
    carried + U * ((silu * value.value).abs() + carried) + TINY
}
