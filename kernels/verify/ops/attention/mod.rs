mod bounds;
mod cases;
mod faults;
mod keys;

pub use cases::{area, shapes};

use crate::prelude::*;
use faults::Fault;
use keys::Keys;
use rayon::prelude::*;
use zipsplat::ops::{Attention, AttentionKernel, Heads, Part, Pool, Tiles, Units};
use zipsplat_reference::ops::{attention::attention_to_means, split_heads};

/// Before pooling: `q [sequences, queries, heads, dim]`, `k` and `v [sequences, keys, heads, dim]`.
#[derive(Clone)]
struct Problem {
    sequences: usize,
    heads: usize,
    dim: usize,
    limits: fn(&mut Limits),
    tiles: Tiles,
    /// Scores whose rounding tests hold to that of random sums.
    is_tame: bool,
    pool: Option<Pool>,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
}

/// `[sequences, queries, heads, dim]`, and inputs as on the device.
struct Truth {
    values: Vec<f64>,
    bounds: Vec<f64>,
    /// `[queries * heads]` of each sequence, and its keys.
    sequences: Vec<(Vec<Row>, Keys)>,
}

struct Row {
    scores: Vec<f64>,
    errors: Vec<f64>,
}

impl Problem {
    fn random(queries: usize, keys: usize, dim: usize, size: f32) -> Self {
        Self::of([1, 2], queries, keys, dim, size)
    }

    fn of([sequences, heads]: [usize; 2], queries: usize, keys: usize, dim: usize, size: f32) -> Self {
        let mut noise = Noise::new((keys * 64 + queries) as u64);
        let row = sequences * heads * dim;
        let [mut q, mut k] = [queries, keys].map(|tokens| noise.values(tokens * row));
        q.iter_mut().chain(&mut k).for_each(|x| *x *= size);
        Self {
            sequences,
            heads,
            dim,
            limits: |_| (),
            tiles: Tiles::BY_RULE,
            is_tame: false,
            pool: None,
            q,
            k,
            v: noise.values(keys * row),
        }
    }

    fn width(&self) -> usize {
        self.heads * self.dim
    }

    fn tokens(&self) -> usize {
        self.k.len() / self.sequences / self.width()
    }

    fn keys(&self) -> usize {
        self.pool.map_or(self.tokens(), |pool| {
            pool.keys_of(self.tokens()) + if pool.own { pool.tokens() - pool.keys() } else { 0 }
        })
    }

    fn pool(&self) -> Option<split_heads::Pool> {
        self.pool.map(|Pool { side, grid, leading, own, first }| split_heads::Pool { side, grid, leading, own, first })
    }

    fn queries(&self) -> usize {
        self.q.len() / self.sequences / self.width()
    }

    /// Sequences, or views that see their own tokens.
    fn parts(&self) -> usize {
        self.pool.filter(|pool| pool.own).map_or(self.sequences, |pool| self.tokens() / pool.tokens())
    }

    fn sequence(&self, s: usize) -> Self {
        let of = |x: &Vec<f32>, parts: usize| x[x.len() / parts * s..][..x.len() / parts].to_vec();
        let [k, v] = [&self.k, &self.v].map(|x| if self.pool.is_some() { x.clone() } else { of(x, self.sequences) });
        // The first view may be whole in any case.
        let pool = self.pool.map(|pool| Pool { own: pool.own && !(pool.first && s == 0), ..pool });
        Self { sequences: 1, pool, q: of(&self.q, self.parts()), k, v, ..*self }
    }

    fn truth_of_one(&self, mode: Mode, view: usize) -> Truth {
        let (q, keys) = (Self::held(&self.q, mode), Keys::new(self, mode, view));
        let counts: Vec<f64> = (0..self.keys()).map(|key| keys.count(key)).collect();
        let values = attention_to_means(&q, [&keys.k, &keys.v], &counts, self.heads, self.dim);
        let scores = |i: usize| self.scores(mode, &q[i * self.dim..][..self.dim], i % self.heads, &keys);
        let rows: Vec<Row> = (0..self.queries() * self.heads).into_par_iter().map(scores).collect();
        let bounds = rows.par_iter().zip(values.par_chunks(self.dim)).enumerate();
        let bounds =
            bounds.flat_map_iter(|(i, (row, out))| self.bounds(mode, row, i % self.heads, &keys, out)).collect();
        Truth { values, bounds, sequences: vec![(rows, keys)] }
    }

    fn kernel(&self, mode: Mode, device: &Device) -> AttentionKernel {
        match mode.units(device) {
            Some(units) => AttentionKernel::Matrix(Units { tiles: self.tiles, ..units }),
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
        let (kernel, width) = (self.kernel(mode, device), self.width());
        let (sequences, queries) = (self.parts(), self.q.len() / self.parts() / width);
        let (common_keys, keys) = match self.pool {
            Some(pool) => (pool.keys_of(self.tokens()), if pool.own { pool.tokens() } else { 0 }),
            None => (0, self.keys()),
        };
        let heads = Heads { count: self.heads, dim: self.dim };
        let shape = Attention { heads, sequences, queries, common_keys, keys, kernel };
        let mut trial = Trial::changed(device, self.limits);
        let tensors = shape.tensors(&mut trial.rec);
        let queries_part = Part { scale: shape.scale(), ..Part::default() };
        let keys_part = Part { keys: true, ..Part::default() };
        let parts = [(&self.q, queries_part), (&self.k, keys_part), (&self.v, Part::default())];
        for ((values, part), tensor) in parts.into_iter().zip(tensors) {
            // NaN in the padding must not reach results.
            trial.blank(tensor);
            let element = kernel.element();
            let (tensor_of_rows, count) = (trial.input_of(element, values), values.len() / width);
            let input = Rows { tensor: tensor_of_rows, count, width, element };
            if part.scale != 0.0 || keys > 0 {
                shape.split(&mut trial.rec, input, 0, part, tensor);
            }
            if let Some(pool) = self.pool.filter(|_| part.scale == 0.0) {
                let out = [tensor, tensors[3]];
                shape.split_common(&mut trial.rec, input.columns(0, width), pool, 0, part, out);
            }
        }
        let out = shape.record(&mut trial.rec, tensors).tensor;
        trial.result_of(kernel.element(), out)
    }

    fn truth(&self, mode: Mode) -> Truth {
        let mut all = Truth { values: Vec::new(), bounds: Vec::new(), sequences: Vec::new() };
        for one in (0..self.parts()).map(|s| self.sequence(s).truth_of_one(mode, s)) {
            all.values.extend(one.values);
            all.bounds.extend(one.bounds);
            all.sequences.extend(one.sequences);
        }
        all
    }

    fn judge(&self, truth: &Truth, output: &Vec<f32>, _: Mode) -> Worst {
        Worst::of(output, &truth.values, |i| truth.bounds[i])
    }

    /// A score sums `dim` products; weights and results sum over keys. Averaging shrinks values and
    /// errors alike.
    fn typical(&self, _: &Device, mode: Mode) -> Tolerance {
        if !self.is_tame {
            return Tolerance::ANY;
        }
        let sums = Tolerance::sum_of(self.dim).and(Tolerance::sum_of(self.keys())).and(Tolerance::ELEMENTWISE);
        match mode.factor {
            Element::F32 => sums,
            // Rounded queries move scores below 1 by less than themselves. Weights and results are
            // rounded, too.
            half => sums.and(Tolerance::sum_of_rounded(half, self.keys())).stored_in(half),
        }
    }

    fn zeros(&self, truth: &Truth) -> Option<Vec<f32>> {
        Some(vec![0.0; truth.values.len()])
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Vec<f32>> {
        if truth.values.is_empty() || fault.is_fine() && mode != Mode::EXACT {
            return Vec::new();
        }
        let wrong = truth.sequences.iter().flat_map(|(rows, keys)| {
            let rows = rows.par_iter().enumerate();
            let wrong = rows.flat_map_iter(|(i, row)| self.wrong(&row.scores, i % self.heads, keys, fault));
            wrong.map(|x| x as f32).collect::<Vec<_>>()
        });
        vec![wrong.collect()]
    }
}
