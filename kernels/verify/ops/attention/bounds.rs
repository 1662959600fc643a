use super::{Keys, Problem, Row};
use crate::prelude::*;

struct Weights {
    highest: f64,
    first: usize,
    /// Limit of increases of the running maximum.
    rises: usize,
    /// Relative to the highest weight.
    total: f64,
    /// Relative rounding of a multiplied weight.
    unit: f64,
    /// Weights below may be flushed.
    least: f64,
}

impl Weights {
    fn new(mode: Mode, scores: &[f64]) -> Self {
        let (mut highest, mut first, mut rises) = (f64::NEG_INFINITY, 0, 0);
        for (key, &score) in scores.iter().enumerate() {
            if score > highest {
                (highest, first, rises) = (score, key, rises + 1);
            }
        }
        let total = scores.iter().map(|score| (score - highest).exp()).sum();
        // Lanes keep f32 weights.
        let (unit, least) =
            if mode.matrix { (mode.factors().unit, mode.factors().tiny.max(TINY)) } else { (0.0, TINY) };
        Self { highest, first, rises, total, unit, least }
    }

    /// Relative error of a score `below` the highest, after exp and each rescale. exp(0) is assumed
    /// to be 1.
    fn relative(&self, below: f64) -> f64 {
        (3.0 * (1 + self.rises) as f64 + 2.0 * below) * ULP + self.unit
    }
}

#[derive(Clone, Copy, Default)]
struct Channel {
    /// Weighted deviations of values, times their weights' errors.
    moved: f64,
    /// Largest distance of a value from the result.
    range: f64,
    size: f64,
    /// `moved` for one dominating key.
    beside: f64,
    /// Loss from flushed subnormals.
    lost: f64,
    /// Weighted errors of the values.
    shifted: f64,
    terms: usize,
}

impl Problem {
    pub fn scores(&self, mode: Mode, query: &[f64], head: usize, keys: &Keys) -> Row {
        let factors = mode.factors();
        let scale = 1.0 / (self.dim as f64).sqrt();
        // Scaled queries are rounded again, unless the scale is a power of two.
        let by_two = self.dim.is_power_of_two() && self.dim.ilog2().is_multiple_of(2);
        let rounded = if by_two { 0.0 } else { factors.unit };
        let relative = factors.sum(self.dim + 2) * (1.0 + rounded) + rounded;
        let least = factors.tiny.max(TINY);
        let score = |key: usize| {
            let at = key * self.width() + head * self.dim;
            let (mut sum, mut size, mut lost, mut moved) = (0.0, 0.0, 0.0, 0.0);
            for (i, (q, k)) in query.iter().zip(&keys.k[at..][..self.dim]).enumerate() {
                let (q, k) = (scale * q, *k);
                sum += q * k;
                moved += q.abs() * keys.key_off(at + i);
                size += (q * k).abs();
                if q.abs() < least || k.abs() < least {
                    lost += (q * k).abs();
                }
            }
            let (more, off) = keys.more(key, sum);
            let error = moved + relative * (size + moved) + lost + self.dim as f64 * TINY;
            (sum + more, off + (1.0 + U) * error)
        };
        let (scores, errors) = (0..self.keys()).map(score).unzip();
        Row { scores, errors }
    }

    pub fn bounds(&self, mode: Mode, row: &Row, head: usize, keys: &Keys, out: &[f64]) -> Vec<f64> {
        let factors = mode.factors();
        let weights = Weights::new(mode, &row.scores);
        let place = |key: usize| key * self.width() + head * self.dim;
        let of_head = |key: usize| &keys.v[place(key)..][..self.dim];
        let least = factors.tiny.max(TINY);
        let mut channels = vec![Channel::default(); self.dim];
        // Weight shares: lower bound, upper bound, possibly flushed.
        let (mut kept, mut grown, mut lost) = (0.0, 0.0, 0.0);
        let first_error = row.errors[weights.first];
        let first_value = of_head(weights.first);
        for (key, (score, error)) in row.scores.iter().zip(&row.errors).enumerate() {
            let below = weights.highest - score;
            let (off, relative) = (error + U * below, weights.relative(below));
            let p = (-below).exp() / weights.total;
            let most = (off - below).exp() * (1.0 + relative) / weights.total;
            let apart = (most - p).max(p * (1.0 - (-off).exp() * (1.0 - relative)));
            kept += p * (-off).exp() * (1.0 - relative).max(0.0);
            grown += most;
            if p * weights.total < 2.0 * weights.least {
                lost += p;
            }
            let own = weights.relative(0.0);
            let beside = if key == weights.first {
                0.0
            } else {
                (off + first_error - below).exp() * (1.0 + relative) / (1.0 - own) + (-below).exp()
            };
            for (c, ((channel, &v), out)) in channels.iter_mut().zip(of_head(key)).zip(out).enumerate() {
                let distance = (v - out).abs();
                channel.moved += apart * distance;
                channel.shifted += most * keys.value_off(place(key) + c);
                channel.range = channel.range.max(distance);
                channel.beside += beside * (v - first_value[c]).abs();
                if v != 0.0 {
                    channel.size += p * v.abs();
                    channel.terms += 1;
                    if v.abs() < least {
                        channel.lost += p * v.abs();
                    }
                }
            }
        }
        // Rounded weights multiply values, unrounded ones make the total; exp(0) does not round.
        let rounded = weights.unit * (1.0 - 1.0 / weights.total);
        // Additions of a lane, then of the subgroup.
        let total = gamma(by_lanes(self.keys()) + weights.rises + 6);
        let output = if mode.factor == Element::F32 { 0.0 } else { factors.unit };
        let bound = |(channel, out): (&Channel, &f64)| {
            let Channel { moved, range, size, beside, lost: flushed, shifted, terms } = *channel;
            let shifted = shifted / kept;
            let carried = (moved / kept).min(range).min(beside) + shifted + rounded * out.abs();
            // By computed weights.
            let size = (size * grown / kept).min(out.abs() + range) + shifted;
            let summed = factors.sum(terms + weights.rises + 1) * size;
            let near = out.abs() + carried + summed;
            let left = carried + summed + (total + DIVISION + U + output) * near + (2.0 * lost * range).min(range);
            let subnormal = if output > 0.0 { (near + left).min(factors.tiny) } else { 0.0 };
            left + flushed + subnormal + (terms + 1) as f64 * TINY * (1.0 + range + out.abs())
        };
        channels.iter().zip(out).map(bound).collect()
    }
}
