use super::Problem;
use crate::prelude::*;
use zipsplat_reference::ops::split_heads::Pool;

/// `[keys, heads, dim]`.
pub struct Keys {
    pub k: Vec<f64>,
    pub v: Vec<f64>,
    pub pooled: Option<Pooled>,
}

pub struct Pooled {
    /// Patches per mean.
    pub counts: Vec<f64>,
    pub off: [Vec<f64>; 2],
}

impl Keys {
    /// Returns the keys of a sequence, or of a view of pooled ones.
    pub fn new(problem: &Problem, mode: Mode, view: usize) -> Self {
        let [k, v] = [&problem.k, &problem.v].map(|values| Problem::held(values, mode));
        match problem.pool() {
            None => Self { k, v, pooled: None },
            Some(pool) => {
                let width = problem.width();
                let seen = |x: &[f64]| means(pool, x, width, mode, view);
                let ((k, counts, k_off), (v, _, v_off)) = (seen(&k), seen(&v));
                Self { k, v, pooled: Some(Pooled { counts, off: [k_off, v_off] }) }
            }
        }
    }

    pub fn count(&self, key: usize) -> f64 {
        self.pooled.as_ref().map_or(1.0, |pooled| pooled.counts[key])
    }

    /// Logarithm added to a key's score, and the sum's error bound.
    pub fn more(&self, key: usize, score: f64) -> (f64, f64) {
        let count = self.count(key);
        let more = count.ln();
        match self.pooled {
            Some(_) => (more, logarithm(count) + U * ((score + more).abs() + logarithm(count))),
            None => (0.0, 0.0),
        }
    }

    pub fn key_off(&self, i: usize) -> f64 {
        self.pooled.as_ref().map_or(0.0, |pooled| pooled.off[0][i])
    }

    pub fn value_off(&self, i: usize) -> f64 {
        self.pooled.as_ref().map_or(0.0, |pooled| pooled.off[1][i])
    }
}

/// Bounds a sum, a division and 16-bit storage, where f16 may round either way.
fn means(pool: Pool, x: &[f64], width: usize, mode: Mode, view: usize) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let (means, counts) = pool.seen(x, width, view);
    let sizes = pool.seen(&x.iter().map(|x| x.abs()).collect::<Vec<_>>(), width, view).0;
    let (unit, tiny) = match mode.factor {
        Element::F16 => (2.0 * mode.factors().unit, mode.factors().tiny),
        _ => (mode.factors().unit, TINY),
    };
    let off = |(i, (mean, size)): (usize, (&f64, &f64))| {
        let summed = (gamma(counts[i / width] as usize) + DIVISION) * size;
        summed + unit * (mean.abs() + summed) + tiny
    };
    let off = means.iter().zip(&sizes).enumerate().map(off).collect();
    (means, counts, off)
}
