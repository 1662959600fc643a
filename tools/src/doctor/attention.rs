//! Softmax attention.

use super::{
    Area, Case, Mode, Worst,
    bound::{DIVISION, TINY, U, ULP},
    trial::Trial,
};
use crate::noise::Noise;
use std::rc::Rc;
use zipsplat::{
    Result,
    gpu::Device,
    ops::{Attention, AttentionKernel, Heads, Part},
};
use zipsplat_reference::{ops::attention::attention, widen};

const REASON: &str = "a score is off by d <= gamma_(D+2) sum|q k|, so its weight by a factor e^d times exp's allowance, 3 + 2|x| \
    units for |x| below the row's maximum and 3 more each time that the maximum rises; an output by the weights' sum \
    p_j |e^d_j - 1| |v_j - out|, never leaving the range of the values, plus gamma_n for the two sums over n keys";

/// One sequence: `q [queries, HEADS, dim]`, `k` and `v [keys, HEADS, dim]`.
struct Problem {
    dim: usize,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
}

const HEADS: usize = 2;

impl Problem {
    /// Random values, times `size` in queries and keys.
    fn random(queries: usize, keys: usize, dim: usize, size: f32) -> Self {
        let mut noise = Noise((keys * 64 + queries) as u64);
        let width = HEADS * dim;
        let [mut q, mut k] = [queries, keys].map(|tokens| noise.values(tokens * width));
        q.iter_mut().chain(&mut k).for_each(|x| *x *= size);
        Self { dim, q, k, v: noise.values(keys * width) }
    }

    fn width(&self) -> usize {
        HEADS * self.dim
    }

    fn keys(&self) -> usize {
        self.k.len() / self.width()
    }

    /// Key `key` of every head times `factor`, in the direction of the first query.
    fn dominate(mut self, key: usize, factor: f32) -> Self {
        let width = self.width();
        for channel in 0..width {
            self.k[key * width + channel] = factor * self.q[channel].signum();
            for query in self.q.chunks_mut(width).skip(1) {
                query[channel] = query[channel].abs() * self.k[key * width + channel].signum();
            }
        }
        self
    }

    fn run(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        let kernel = match mode.units(device) {
            Some(units) => AttentionKernel::Matrix(units),
            None => AttentionKernel::Lanes(mode.factor),
        };
        let width = self.width();
        let (queries, keys) = (self.q.len() / width, self.keys());
        let shape = Attention { heads: Heads { count: HEADS, dim: self.dim }, sequences: 1, queries, keys, kernel };
        let mut trial = Trial::new(device);
        let tensors = shape.tensors(&mut trial.rec);
        let queries_part = Part { scale: shape.scale(), ..Part::default() };
        let keys_part = Part { keys: true, ..Part::default() };
        let parts = [(&self.q, queries, queries_part), (&self.k, keys, keys_part), (&self.v, keys, Part::default())];
        for ((values, rows, part), tensor) in parts.into_iter().zip(tensors) {
            // Padding holds NaN, which must reach nothing.
            trial.blank(tensor);
            let input = trial.input(&kernel.element().encode(values));
            shape.split(&mut trial.rec, (input, width), 0, rows, part, tensor);
        }
        let out = shape.record(&mut trial.rec, tensors);
        trial.rec.output(out);
        Ok(kernel.element().decode(&trial.result::<u8>(out)?))
    }

    fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        let got = self.run(device, mode)?;
        let largest = mode.factors().largest;
        let held =
            |values: &[f32]| -> Vec<f64> { widen(values).into_iter().map(|x| x.clamp(-largest, largest)).collect() };
        let [q, k, v] = [&self.q, &self.k, &self.v].map(|values| held(values));
        let truth = attention(&q, &k, &v, HEADS, self.dim);
        let rows = truth.chunks(self.dim).enumerate();
        let bounds: Vec<f64> = rows
            .flat_map(|(i, out)| self.bounds(mode, &q[i * self.dim..][..self.dim], i % HEADS, (&k, &v), out))
            .collect();
        Ok(Worst::of(&got, &truth, |i| bounds[i]))
    }

    /// Bounds of the errors of one query's output `out [dim]`.
    fn bounds(&self, mode: Mode, query: &[f64], head: usize, (k, v): (&[f64], &[f64]), out: &[f64]) -> Vec<f64> {
        let factors = mode.factors();
        let scale = 1.0 / (self.dim as f64).sqrt();
        let of_head =
            |values: &'_ [f64], key: usize| values[key * self.width() + head * self.dim..][..self.dim].to_vec();
        // Queries are rounded again when they have been scaled.
        let rounded = (1.0 + factors.unit).powi(3) - 1.0;
        let relative = factors.sum(self.dim + 2) * (1.0 + rounded) + rounded;
        let query_sum: f64 = query.iter().map(|q| scale * q.abs()).sum();
        let scores: Vec<[f64; 3]> = (0..self.keys())
            .map(|key| {
                let products = of_head(k, key).into_iter().zip(query).map(|(k, q)| (scale * k * q, k.abs()));
                products.fold([0.0; 3], |[sum, size, keys], (p, k)| [sum + p, size + p.abs(), keys + k])
            })
            .collect();
        // How often a running maximum may rise.
        let (mut highest, mut rises) = (f64::NEG_INFINITY, 0);
        for &[score, ..] in &scores {
            if score > highest {
                (highest, rises) = (score, rises + 1);
            }
        }
        let total: f64 = scores.iter().map(|[score, ..]| (score - highest).exp()).sum();
        let mut sums = vec![[0.0f64; 3]; self.dim];
        let (mut kept, mut grown, mut lost) = (0.0, 0.0, 0.0);
        for (key, [score, size, key_sum]) in scores.iter().enumerate() {
            let below = highest - score;
            let exponent = relative * size + factors.tiny * (query_sum + 2.0 * key_sum) + U * below;
            let allowance = (3.0 * (1 + rises) as f64 + 2.0 * below) * ULP + factors.unit;
            let (p, off) = ((-below).exp() / total, (exponent + allowance).exp_m1());
            kept += p * (-(exponent + allowance)).exp();
            grown += p * (1.0 + off);
            // Of a weight that is flushed, all is lost.
            lost += p.min((TINY + factors.tiny) / total);
            for ((sum, v), out) in sums.iter_mut().zip(of_head(v, key)).zip(out) {
                *sum = [sum[0] + p * off * (v - out).abs(), sum[1].max((v - out).abs()), sum[2] + p * v.abs()];
            }
        }
        let n = self.keys();
        let summed = factors.sum(n + 2 * rises) + factors.unit;
        let bound = |(sum, out): (&[f64; 3], &f64)| {
            let [moved, range, size] = *sum;
            let carried = (moved / kept).min(range);
            // The weights, too, are those that were computed.
            let size = (size * grown / kept).min(out.abs() + range);
            carried
                + summed * (size + out.abs() + carried)
                + (DIVISION + factors.unit) * (out.abs() + carried)
                + (2.0 * lost * range).min(range)
                + n as f64 * TINY * (1.0 + range + out.abs())
                + factors.tiny
        };
        sums.iter().zip(out).map(bound).collect()
    }
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, make: Box<dyn Fn() -> Problem>| {
        let size = make().keys();
        let make = Rc::new(make);
        cases.push(Case::new(name, size, move |device, mode| make().check(device, mode)));
    };
    for keys in [1, 2, 31, 32, 33, 127, 129, 1300, 62_401, 200_000] {
        let queries = if keys > 2_000 { 3 } else { 17 };
        add("random", Box::new(move || Problem::random(queries, keys, 64, 1.0)));
    }
    // Workgroups of several subgroups, which wait for each other.
    add("many queries", Box::new(|| Problem::random(600, 129, 64, 1.0)));
    for dim in [8, 48, 96, 128] {
        add(&format!("heads of {dim} channels"), Box::new(move || Problem::random(9, 70, dim, 1.0)));
    }
    add("logits of +-1e4", Box::new(|| Problem::random(9, 325, 64, 120.0)));
    add("activations of 1e4 before any norm", Box::new(|| Problem::random(9, 325, 64, 1e4)));
    add("all logits equal", Box::new(|| Problem { q: vec![0.0; 9 * 128], ..Problem::random(9, 325, 64, 1.0) }));
    add("identical keys and values", Box::new(identical));
    for (keys, key) in [(33, 0), (33, 32), (1300, 800), (62_401, 62_400)] {
        let name = format!("key {key} dominates");
        add(&name, Box::new(move || Problem::random(3, keys, 64, 4.0).dominate(key, 40.0)));
    }
    add("maximum rises with every key", Box::new(rising));
    add(
        "all logits far below zero",
        Box::new(|| {
            let mut problem = Problem::random(5, 70, 64, 1.0);
            problem.q.fill(30.0);
            problem.k.iter_mut().for_each(|k| *k -= 40.0);
            problem
        }),
    );
    add("values near the largest f16", Box::new(|| values_of(65_000.0)));
    add("values of 1e30", Box::new(|| values_of(1e30)));
    add("subnormal values", Box::new(|| values_of(1e-39)));
    Area { kernel: "ops/attention", size: "keys", reason: REASON, modes: Mode::FLOATS, cases }
}

fn identical() -> Problem {
    let mut problem = Problem::random(5, 1300, 64, 1.0);
    for values in [&mut problem.k, &mut problem.v] {
        let first = values[..128].to_vec();
        values.chunks_mut(128).for_each(|row| row.copy_from_slice(&first));
    }
    problem
}

/// Every key scores higher than those before: all that was summed is scaled again and again.
fn rising() -> Problem {
    let mut problem = Problem::random(5, 500, 64, 1.0);
    problem.q.fill(1.0);
    for (key, row) in problem.k.chunks_mut(128).enumerate() {
        row.iter_mut().for_each(|k| *k = 0.02 * key as f32 + 0.01 * *k);
    }
    problem
}

fn values_of(size: f32) -> Problem {
    let mut problem = Problem::random(9, 325, 64, 1.0);
    problem.v.iter_mut().for_each(|v| *v *= size);
    problem
}
