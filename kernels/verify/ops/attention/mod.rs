//! Softmax attention.

mod bounds;
mod cases;
mod faults;
mod keys;

pub use cases::area;

use crate::{Mode, Worst, case, noise::Noise, trial::Trial};
use faults::Fault;
use keys::Keys;
use rayon::prelude::*;
use zipsplat::{
    Result,
    gpu::Device,
    ops::{Attention, AttentionKernel, Heads, Part, Pool, Rows},
};
use zipsplat_reference::ops::{attention::attention_to_means, split_heads};

const HEADS: usize = 2;

/// One sequence before pooling: `q [queries, HEADS, dim]`, `k` and `v [keys, HEADS, dim]`.
struct Problem {
    dim: usize,
    pool: Option<Pool>,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
}

/// Result `[queries, HEADS, dim]` and inputs as on the device.
struct Truth {
    values: Vec<f64>,
    bounds: Vec<f64>,
    /// `[queries * HEADS]`
    rows: Vec<Row>,
    keys: Keys,
}

struct Row {
    scores: Vec<f64>,
    errors: Vec<f64>,
}

impl Problem {
    /// Scales random queries and keys by `size`.
    fn random(queries: usize, keys: usize, dim: usize, size: f32) -> Self {
        let mut noise = Noise((keys * 64 + queries) as u64);
        let width = HEADS * dim;
        let [mut q, mut k] = [queries, keys].map(|tokens| noise.values(tokens * width));
        q.iter_mut().chain(&mut k).for_each(|x| *x *= size);
        Self { dim, pool: None, q, k, v: noise.values(keys * width) }
    }

    fn width(&self) -> usize {
        HEADS * self.dim
    }

    fn tokens(&self) -> usize {
        self.k.len() / self.width()
    }

    fn keys(&self) -> usize {
        self.pool.map_or(self.tokens(), |pool| self.tokens() / pool.tokens() * pool.keys())
    }

    fn pool(&self) -> Option<split_heads::Pool> {
        self.pool.map(|Pool { side, grid, leading }| split_heads::Pool { side, grid, leading })
    }

    fn queries(&self) -> usize {
        self.q.len() / self.width()
    }

    fn kernel(mode: Mode, device: &Device) -> AttentionKernel {
        match mode.units(device) {
            Some(units) => AttentionKernel::Matrix(units),
            None => AttentionKernel::Lanes(mode.factor),
        }
    }

    fn held(values: &[f32], mode: Mode) -> Vec<f64> {
        mode.factor.decode(&mode.factor.encode(values)).into_iter().map(f64::from).collect()
    }
}

impl case::Problem for Problem {
    type Output = Vec<f32>;
    type Truth = Truth;
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        let (kernel, width) = (Self::kernel(mode, device), self.width());
        let (queries, keys, pool) = (self.queries(), self.keys(), self.pool);
        let shape =
            Attention { heads: Heads { count: HEADS, dim: self.dim }, sequences: 1, queries, keys, pool, kernel };
        let mut trial = Trial::new(device);
        let tensors = shape.tensors(&mut trial.rec);
        let queries_part = Part { scale: shape.scale(), ..Part::default() };
        let keys_part = Part { keys: true, log_counts: Some(tensors[3]), ..Part::default() };
        let tokens = self.tokens();
        let parts =
            [(&self.q, queries, queries_part), (&self.k, tokens, keys_part), (&self.v, tokens, Part::default())];
        for ((values, count, part), tensor) in parts.into_iter().zip(tensors) {
            // NaN in the padding must not reach results.
            trial.blank(tensor);
            let element = kernel.element();
            let input = Rows { tensor: trial.input(&element.encode(values)), count, width, element };
            shape.split(&mut trial.rec, input, 0, part, tensor);
        }
        let out = shape.record(&mut trial.rec, tensors).tensor;
        trial.rec.output(out);
        Ok(kernel.element().decode(&trial.result::<u8>(out)?))
    }

    fn truth(&self, mode: Mode) -> Truth {
        let (q, keys) = (Self::held(&self.q, mode), Keys::new(self, mode));
        let counts: Vec<f64> = (0..self.keys()).map(|key| keys.count(key)).collect();
        let values = attention_to_means(&q, [&keys.k, &keys.v], &counts, HEADS, self.dim);
        let at = |i: usize| (&q[i * self.dim..][..self.dim], i % HEADS);
        let rows: Vec<Row> =
            (0..self.queries() * HEADS).into_par_iter().map(|i| self.scores(mode, at(i), &keys)).collect();
        let bounds = rows.par_iter().zip(values.par_chunks(self.dim)).enumerate();
        let bounds = bounds.flat_map_iter(|(i, (row, out))| self.bounds(mode, row, i % HEADS, &keys, out)).collect();
        Truth { values, bounds, rows, keys }
    }

    fn judge(&self, truth: &Truth, output: &Vec<f32>, _: Mode) -> Worst {
        Worst::of(output, &truth.values, |i| truth.bounds[i])
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Vec<f32>> {
        if fault.is_fine() && mode != Mode::EXACT {
            return Vec::new();
        }
        let rows = truth.rows.par_iter().enumerate();
        let wrong = rows.flat_map_iter(|(i, row)| self.wrong(&row.scores, i % HEADS, &truth.keys, fault));
        vec![wrong.map(|x| x as f32).collect()]
    }
}
