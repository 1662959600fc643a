//! Linear layers with what follows them: GELU, SwiGLU, layer scale, residual.

use super::{
    Area, Case, Factors, Mode, Worst,
    bound::{DIVISION, TINY, U, ULP, exponential},
    trial::Trial,
};
use crate::noise::Noise;
use std::rc::Rc;
use zipsplat::{
    Result,
    gpu::{Device, Element},
    ops::{Activation, Epilogue, Linear, LinearKernel, pack_matrix},
};
use zipsplat_reference::{
    ops::{
        activation::{gelu, sigmoid, swiglu},
        linear::linear,
    },
    widen,
};

const REASON: &str = "|error| <= gamma_(K+1) (|x| |W| + |b|) in every element, whatever the order of the sum (Higham, \
    section 3.5), carried through the activation's slope, plus Vulkan's limits for exp and division; factors rounded to 11 \
    or 8 bits add twice their unit roundoff, 8-bit integers half a step of a row's 127 for each factor";

/// One layer and its input: `x [rows, inner]`, `weight [columns, inner]`.
struct Problem {
    rows: usize,
    inner: usize,
    columns: usize,
    x: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
    activation: Activation,
    /// Layer scale and what the result is added to.
    scaled: bool,
}

impl Problem {
    fn random(rows: usize, inner: usize, columns: usize) -> Self {
        let mut noise = Noise((rows * 31 + inner * 7 + columns) as u64);
        let (x, weight, bias) = (noise.values(rows * inner), noise.values(columns * inner), noise.values(columns));
        Self { rows, inner, columns, x, weight, bias, activation: Activation::None, scaled: false }
    }

    fn gamma(&self) -> Vec<f32> {
        Noise(71).values(self.columns)
    }

    fn stream(&self) -> Vec<f32> {
        Noise(72).values(self.rows * self.columns)
    }

    fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        let got = self.run(device, mode)?;
        let factors = mode.factors();
        let held = |values: &[f32]| -> Vec<f64> {
            values.iter().map(|&v| f64::from(v).clamp(-factors.largest, factors.largest)).collect()
        };
        let weight: Vec<f32> = held(&self.weight).iter().map(|&w| w as f32).collect();
        let sums = linear(&held(&self.x), &weight, &self.bias);
        let errors = self.sum_errors(factors);
        let (truth, errors) = match self.activation {
            Activation::None => (sums, errors),
            Activation::Gelu => {
                let error = |(&z, e): (&f64, f64)| gelu_error(z, e);
                (sums.iter().map(|&z| gelu(z)).collect(), sums.iter().zip(errors).map(error).collect())
            }
            Activation::SwiGlu => {
                let half = self.columns / 2;
                let error = |i: usize| {
                    let [gate, value] = [i / half * self.columns + i % half, i / half * self.columns + half + i % half];
                    swiglu_error([sums[gate], sums[value]], [errors[gate], errors[value]])
                };
                (swiglu(&sums, half), (0..self.rows * half).map(error).collect::<Vec<_>>())
            }
        };
        if !self.scaled {
            return Ok(Worst::of(&got, &truth, |i| errors[i]));
        }
        let (gamma, stream) = (self.gamma(), widen(&self.stream()));
        let scaled: Vec<f64> = truth.iter().enumerate().map(|(i, y)| y * f64::from(gamma[i % self.columns])).collect();
        let added: Vec<f64> = scaled.iter().zip(&stream).map(|(y, r)| y + r).collect();
        Ok(Worst::of(&got, &added, |i| {
            let carried = errors[i] * f64::from(gamma[i % self.columns].abs());
            carried + 2.0 * U * (scaled[i].abs() + added[i].abs() + carried) + TINY
        }))
    }

    fn run(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        let kernel = self.kernel(device, mode);
        let mut trial = Trial::new(device);
        // Of a SwiGLU layer gate and value alternate on the device.
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
        let out_columns = layer.out_columns(self.activation);
        let padding = vec![0.0; layer.inner - self.inner];
        let rows: Vec<f32> = self.x.chunks(self.inner).flat_map(|row| [row, &padding].concat()).collect();
        let input = trial.input(&kernel.element().encode(&rows));
        let (out, epilogue) = if self.scaled {
            let (gamma, stream) = (trial.input(&self.gamma()), trial.input(&self.stream()));
            trial.rec.output(stream);
            (
                stream,
                Epilogue {
                    activation: self.activation,
                    gamma: Some(gamma),
                    residual: Some(stream),
                    ..Epilogue::default()
                },
            )
        } else {
            let out = trial.output::<f32>(self.rows * out_columns);
            (out, Epilogue { activation: self.activation, ..Epilogue::default() })
        };
        layer.record(&mut trial.rec, input, self.rows, out, epilogue);
        trial.result(out)
    }

    /// As the engine chooses it: matrix units write whole vectors.
    fn kernel(&self, device: &Device, mode: Mode) -> LinearKernel {
        match (mode.units(device).filter(|_| self.columns.is_multiple_of(8)), mode.factor) {
            (Some(units), _) => LinearKernel::Matrix(units),
            (None, Element::I8) => LinearKernel::Panels(Element::F16),
            (None, element) => LinearKernel::Panels(element),
        }
    }

    /// Bound of every sum's error, `[rows, columns]`.
    fn sum_errors(&self, factors: Factors) -> Vec<f64> {
        let magnitudes = |values: &[f32]| values.iter().map(|v| v.abs()).collect::<Vec<_>>();
        let magnitude = linear(&widen(&magnitudes(&self.x)), &magnitudes(&self.weight), &magnitudes(&self.bias));
        let sum = |values: &[f32]| values.iter().map(|&v| f64::from(v.abs())).sum::<f64>();
        let x_sums: Vec<f64> = self.x.chunks(self.inner).map(sum).collect();
        let weight_sums: Vec<f64> = self.weight.chunks(self.inner).map(sum).collect();
        let rounded = 2.0 * factors.unit + factors.unit * factors.unit;
        let relative = factors.sum(self.inner + 1) * (1.0 + rounded) + rounded;
        let most = |values: &[f32]| values.iter().fold(0.0, |most: f64, v| most.max(f64::from(v.abs())));
        let x_steps: Vec<f64> =
            self.x.chunks(self.inner).map(|row| factors.step * (1.0 + factors.unit) * most(row)).collect();
        let weight_steps: Vec<f64> = self.weight.chunks(self.inner).map(|row| factors.step * most(row)).collect();
        let stepped = |i: usize| {
            let (row, column) = (i / self.columns, i % self.columns);
            let beside = x_steps[row] * weight_sums[column] + weight_steps[column] * x_sums[row];
            beside + self.inner as f64 * x_steps[row] * weight_steps[column]
        };
        // A factor or a product near zero may be flushed.
        let flushed = |i: usize| {
            let beside = x_sums[i / self.columns] + weight_sums[i % self.columns];
            (TINY + factors.tiny) * beside + (self.inner + 1) as f64 * TINY
        };
        magnitude.iter().enumerate().map(|(i, m)| relative * m + flushed(i) + stepped(i)).collect()
    }
}

/// Bound of GELU's error at `z`, which is off by `error`. Its slope is at most 1.13; `shared/gelu.glsl` fits erf to 1.2e-7.
fn gelu_error(z: f64, error: f64) -> f64 {
    let t = z.abs() * std::f64::consts::FRAC_1_SQRT_2;
    let decayed = (-t * t).exp();
    let from_exp = if t < 1.0 { 0.0 } else { exponential(t * t) * decayed * 0.43 };
    let from_argument = 2.0 * U * t * 1.13 * decayed;
    let own = 0.5 * z.abs() * (1.2e-7 + from_exp + from_argument) + 3.0 * U * z.abs().min(gelu(z).abs() + 1.0);
    1.13 * error + own + TINY
}

/// Bound of the error of silu(gate) * value. The slope of SiLU is at most 1.1.
fn swiglu_error([gate, value]: [f64; 2], [gate_error, value_error]: [f64; 2]) -> f64 {
    let silu = gate * sigmoid(gate);
    let own = silu.abs() * ((1.0 - sigmoid(gate)) * exponential(gate) + DIVISION + ULP);
    // 1 + exp(-gate) above 2^126 may divide to zero.
    let silu_error = 1.1 * gate_error + own + gate.abs() * TINY;
    let carried = silu_error * (value.abs() + value_error) + silu.abs() * value_error;
    carried + U * ((silu * value).abs() + carried) + TINY
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, problem: Problem| {
        let (size, problem) = (problem.inner, Rc::new(problem));
        cases.push(Case::new(name, size, move |device, mode| problem.check(device, mode)));
    };
    for inner in [4, 68, 384, 588, 1536, 4096, 8192] {
        add("random", Problem::random(17, inner, 40));
    }
    for (rows, columns) in [(0, 8), (1, 1), (33, 5), (16, 130), (300, 264)] {
        add(&format!("{rows} rows, {columns} columns"), Problem::random(rows, 12, columns));
    }
    add("sums that cancel, condition 1e7", cancelling());
    add("outlier channels of 1e4", outliers());
    add("one channel at a time", one_hot());
    let scaled = |factor: f32, mut p: Problem| {
        p.x.iter_mut().for_each(|x| *x *= factor);
        p
    };
    add("subnormal inputs", scaled(1e-40, Problem::random(5, 64, 40)));
    add("sums beyond the largest f16", scaled(1e4, Problem::random(5, 256, 40)));
    for (name, activation) in [("GELU", Activation::Gelu), ("SwiGLU", Activation::SwiGlu)] {
        add(name, Problem { activation, ..Problem::random(21, 384, 64) });
        // Sums of one term hide nothing of the function itself.
        add(&format!("{name} of every value from -10 to 10"), Problem { activation, ..alone() });
        // Sums to +-120: exp overflows and underflows on the way.
        add(&format!("{name} far from zero"), Problem { activation, ..scaled(12.0, Problem::random(40, 64, 64)) });
    }
    let beyond = Problem { activation: Activation::SwiGlu, ..scaled(1e3, Problem::random(9, 64, 64)) };
    add("SwiGLU products beyond the largest f16", beyond);
    add("layer scale and residual in place", Problem { scaled: true, ..Problem::random(37, 384, 56) });
    Area { kernel: "ops/linear", size: "terms of a sum (K)", reason: REASON, modes: Mode::ALL, cases }
}

/// Sums that are one input each, from -10 to 10; gates and values take them from different channels.
fn alone() -> Problem {
    let mut problem = Problem::random(2001, 4, 8);
    problem.x.iter_mut().enumerate().for_each(|(i, x)| *x = ((i / 4 * (1 + i % 4)) % 2001) as f32 / 100.0 - 10.0);
    problem.weight.iter_mut().enumerate().for_each(|(i, w)| *w = if i / 4 % 4 == (i + i / 16) % 4 { 1.0 } else { 0.0 });
    problem.bias.fill(0.0);
    problem
}

/// Neighbours cancel but for one part in 1e7.
fn cancelling() -> Problem {
    let mut problem = Problem::random(9, 2048, 40);
    for row in problem.weight.chunks_mut(2) {
        row[1] = -row[0];
    }
    for pair in problem.x.chunks_mut(2) {
        pair[1] = f32::from_bits(pair[0].to_bits() ^ 1);
    }
    problem.bias.fill(0.0);
    problem
}

fn outliers() -> Problem {
    let mut problem = Problem::random(9, 1536, 40);
    for row in problem.x.chunks_mut(1536) {
        (row[7], row[900]) = (1e4 * row[7].signum(), -7e3);
    }
    problem
}

/// Every row takes one column of the weight: a wrong index cannot hide in a sum.
fn one_hot() -> Problem {
    let mut problem = Problem::random(68, 68, 70);
    problem.x.iter_mut().enumerate().for_each(|(i, x)| *x = if i / 68 == i % 68 { 1.0 } else { 0.0 });
    problem
}
