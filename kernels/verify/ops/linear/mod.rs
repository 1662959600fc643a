//! Linear layers with GELU, SwiGLU, layer scale and residual.

mod cases;
mod faults;
mod held;
mod q8;

pub use cases::area;
pub use q8::q8_area;

use crate::{
    Mode, Worst,
    bound::{DIVISION, TINY, U, ULP, exponential, gamma},
    case,
    noise::Noise,
    trial::{Trial, UNWRITTEN},
};
use faults::Fault;
use held::Held;
use rayon::prelude::*;
use zipsplat::{
    Result,
    gpu::{Device, Element},
    ops::{Activation, Epilogue, Linear, LinearKernel, Rows, Weights, pack_matrix},
};
use zipsplat_reference::ops::activation::{gelu, sigmoid, silu};

/// Layer and input: `x [rows, inner]`, `weight [columns, inner]`.
struct Problem {
    rows: usize,
    inner: usize,
    columns: usize,
    x: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
    activation: Activation,
    /// Layer scale and residual.
    scaled: bool,
    /// Whole numbers with exact f32 partial sums in any order.
    whole: bool,
}

/// Result `[rows, out_columns]`, and factors as on the device.
struct Truth {
    values: Vec<f64>,
    errors: Vec<f64>,
    held: Held,
    sums: Vec<f64>,
}

/// Sum with bias, and error bound.
struct Sum {
    value: f64,
    error: f64,
}

impl Problem {
    fn random(rows: usize, inner: usize, columns: usize) -> Self {
        let mut noise = Noise((rows * 31 + inner * 7 + columns) as u64);
        let (x, weight, bias) = (noise.values(rows * inner), noise.values(columns * inner), noise.values(columns));
        Self { rows, inner, columns, x, weight, bias, activation: Activation::None, scaled: false, whole: false }
    }

    fn gamma(&self) -> Vec<f32> {
        Noise(71).values(self.columns)
    }

    fn stream(&self) -> Vec<f32> {
        Noise(72).values(self.rows * self.columns)
    }

    fn out_columns(&self) -> usize {
        if self.activation == Activation::SwiGlu { self.columns / 2 } else { self.columns }
    }

    /// Returns the factor type; matrix units and dot products write whole vectors.
    fn factor(&self, mode: Mode) -> Element {
        match mode.factor {
            Element::I8 if !self.columns.is_multiple_of(8) => Element::F16,
            factor => factor,
        }
    }

    fn kernel(&self, device: &Device, mode: Mode) -> LinearKernel {
        match mode.units(device).filter(|_| self.columns.is_multiple_of(8)) {
            Some(units) => LinearKernel::Matrix(units, mode.weights),
            None => mode.on_lanes(self.factor(mode)),
        }
    }

    /// Returns the relative error of an expanded 8-bit weight on matrix units. f16 may round either
    /// way; bf16 rounds to nearest.
    fn expanding(&self, mode: Mode) -> f64 {
        let becomes_factor = mode.weights == Weights::Q8 && mode.matrix && self.columns.is_multiple_of(8);
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

    /// Applies the epilogue to sums `[rows, columns]`.
    fn finish(&self, sums: &[f64]) -> Vec<f64> {
        let values: Vec<f64> = match self.activation {
            Activation::None => sums.to_vec(),
            Activation::Gelu => sums.iter().map(|&z| gelu(z)).collect(),
            Activation::SwiGlu => self.gated(sums, |gate, value| silu(gate) * value),
        };
        if self.scaled { self.added(&values, |value, gamma, residual| value * gamma + residual) } else { values }
    }

    fn gated<T: Copy, R>(&self, sums: &[T], function: impl Fn(T, T) -> R) -> Vec<R> {
        let half = self.columns / 2;
        let rows = sums.chunks(self.columns.max(1));
        rows.flat_map(|row| (0..half).map(|j| function(row[j], row[half + j])).collect::<Vec<_>>()).collect()
    }

    fn added(&self, values: &[f64], function: impl Fn(f64, f64, f64) -> f64) -> Vec<f64> {
        let (gamma, stream) = (self.gamma(), self.stream());
        let one = |(i, &value): (usize, &f64)| function(value, gamma[i % self.columns].into(), stream[i].into());
        values.iter().enumerate().map(one).collect()
    }

    fn errors(&self, sums: &[Sum]) -> Vec<f64> {
        let errors: Vec<f64> = match self.activation {
            Activation::None => sums.iter().map(|sum| sum.error).collect(),
            Activation::Gelu => sums.iter().map(gelu_error).collect(),
            Activation::SwiGlu => {
                let places: Vec<usize> = (0..sums.len()).collect();
                self.gated(&places, |gate, value| swiglu_error(&sums[gate], &sums[value]))
            }
        };
        if !self.scaled {
            return errors;
        }
        let scaled = |(error, sum): (&f64, &Sum)| (*error, sum.value);
        let (gamma, stream) = (self.gamma(), self.stream());
        let one = |(i, (error, value)): (usize, (f64, f64))| {
            let gamma = f64::from(gamma[i % self.columns]);
            let (carried, scaled) = (error * gamma.abs(), value * gamma);
            carried + 2.0 * U * (scaled.abs() + (scaled + f64::from(stream[i])).abs() + carried) + TINY
        };
        errors.iter().zip(sums).map(scaled).enumerate().map(one).collect()
    }

    /// Returns a row past the end that kernels must not write.
    fn guard(&self) -> usize {
        self.out_columns()
    }
}

impl case::Problem for Problem {
    type Output = Vec<f32>;
    type Truth = Truth;
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        let kernel = self.kernel(device, mode);
        let mut trial = Trial::new(device);
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
        let input = Rows { tensor: trial.input(&element.encode(&rows)), count: self.rows, width: layer.inner, element };
        let out_rows = |tensor| Rows::new(tensor, self.rows, self.out_columns());
        let mut epilogue = Epilogue { activation: self.activation, ..Epilogue::default() };
        let out = if self.scaled {
            let guarded = [self.stream(), vec![f32::from_bits(UNWRITTEN); self.guard()]].concat();
            let (gamma, stream) = (trial.input(&self.gamma()), trial.input(&guarded));
            trial.rec.output(stream);
            (epilogue.gamma, epilogue.residual) = (Some(gamma), Some(out_rows(stream)));
            stream
        } else {
            trial.output::<f32>(self.rows * self.out_columns() + self.guard())
        };
        layer.record(&mut trial.rec, input, out_rows(out), epilogue);
        trial.result(out)
    }

    fn truth(&self, mode: Mode) -> Truth {
        let held = Held::new(self, mode, f64::round_ties_even);
        let row = |row: usize| (0..self.columns).map(move |column| (row, column));
        let places: Vec<_> = (0..self.rows).flat_map(row).collect();
        let sums: Vec<Sum> = places.into_par_iter().map(|(row, column)| self.sum(&held, mode, row, column)).collect();
        let errors = self.errors(&sums);
        let sums: Vec<f64> = sums.iter().map(|sum| sum.value).collect();
        Truth { values: self.finish(&sums), errors, held, sums }
    }

    fn judge(&self, truth: &Truth, output: &Vec<f32>, _: Mode) -> Worst {
        let (got, guard) = output.split_at(truth.values.len());
        let bits: Vec<u32> = guard.iter().map(|x| x.to_bits()).collect();
        Worst::of(got, &truth.values, |i| truth.errors[i]).or(Worst::differing(&bits, &vec![UNWRITTEN; self.guard()]))
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Vec<f32>> {
        let guarded = |values: Vec<f64>| {
            let values = values.into_iter().map(|x| x as f32);
            values.chain(vec![f32::from_bits(UNWRITTEN); self.guard()]).collect()
        };
        match fault {
            Fault::PastEnd => vec![vec![0.0; truth.values.len() + self.guard()]],
            _ => self.wrong(truth, fault, mode).into_iter().map(guarded).collect(),
        }
    }
}

/// Bounds GELU: its slope is at most 1.13, and `shared/gelu.glsl` fits erf to 1.2e-7.
fn gelu_error(&Sum { value: z, error }: &Sum) -> f64 {
    let t = z.abs() * std::f64::consts::FRAC_1_SQRT_2;
    let decayed = (-t * t).exp();
    let from_exp = if t < 1.0 { 0.0 } else { exponential(t * t) * decayed * 0.43 };
    let from_argument = 2.0 * U * t * 1.13 * decayed;
    let own = 0.5 * z.abs() * (1.2e-7 + from_exp + from_argument) + 3.0 * U * z.abs().min(gelu(z).abs() + 1.0);
    1.13 * error + own + TINY
}

/// Bounds SwiGLU: SiLU's slope is at most 1.1.
fn swiglu_error(gate: &Sum, value: &Sum) -> f64 {
    let silu = silu(gate.value);
    let own = silu.abs() * ((1.0 - sigmoid(gate.value)) * exponential(gate.value) + DIVISION + ULP);
    // 1 + exp(-gate) above 2^126 may divide to zero.
    let silu_error = 1.1 * gate.error + own + gate.value.abs() * TINY;
    let carried = silu_error * (value.value.abs() + value.error) + silu.abs() * value.error;
    carried + U * ((silu * value.value).abs() + carried) + TINY
}
