use super::Problem;
use crate::Mode;
use zipsplat::{gpu::Element, ops::Weights};

/// Rounding may go either way this near to a tie: a division and a product of values up to 127,
/// `127 (2.5 + 0.5)` units.
const NEAR_TIE: f64 = 5e-5;

/// Factors as stored on a device, in f64.
pub struct Held {
    /// `[rows, inner]`
    pub x: Vec<f64>,
    /// `[columns, inner]`
    pub weight: Vec<f64>,
    /// Nonzero channels of each row.
    pub channels: Vec<Vec<usize>>,
    /// Channels near an 8-bit tie, with their step size.
    pub moves: Vec<Vec<(usize, f64)>>,
}

impl Held {
    /// `round` makes the integers.
    pub fn new(problem: &Problem, mode: Mode, round: fn(f64) -> f64) -> Self {
        let factor = problem.factor(mode);
        let stored = if factor == Element::I8 { Element::F16 } else { factor };
        let mut x = rounded(&problem.x, stored);
        let (mut weight, mut moves) = (rounded(&problem.weight, factor), vec![Vec::new(); problem.rows]);
        if mode.weights == Weights::Q8 {
            let (stored, mut values) = (problem.q8(), problem.weight.clone());
            stored.values(&mut values);
            weight = values.into_iter().map(f64::from).collect();
        }
        if factor == Element::I8 {
            weight = integers(&problem.weight, problem.inner);
            for (row, moves) in x.chunks_mut(problem.inner).zip(&mut moves) {
                *moves = quantize(row, round);
            }
        }
        let used = |row: &[f64]| (0..row.len()).filter(|&k| row[k] != 0.0).collect();
        let moved = |(row, moves): (&[f64], &Vec<(usize, f64)>)| -> Vec<usize> {
            let mut channels: Vec<usize> = used(row);
            channels.extend(moves.iter().map(|at| at.0).filter(|&k| row[k] == 0.0));
            channels
        };
        let channels = x.chunks(problem.inner).zip(&moves).map(moved).collect();
        Self { x, weight, channels, moves }
    }
}

fn rounded(values: &[f32], element: Element) -> Vec<f64> {
    match element {
        Element::I8 => Vec::new(),
        _ => element.decode(&element.encode(values)).into_iter().map(f64::from).collect(),
    }
}

/// As `pack_matrix`.
fn integers(weight: &[f32], inner: usize) -> Vec<f64> {
    let row = |row: &[f32]| {
        let largest = row.iter().fold(0f32, |most, x| most.max(x.abs()));
        let steps = 127.0 / largest.max(f32::MIN_POSITIVE);
        let scale = f64::from(largest / 127.0);
        row.iter().map(|x| scale * f64::from((x * steps).round_ties_even())).collect::<Vec<_>>()
    };
    weight.chunks(inner).flat_map(row).collect()
}

/// As `quantize_rows.comp`; returns the near-ties.
fn quantize(row: &mut [f64], round: fn(f64) -> f64) -> Vec<(usize, f64)> {
    let scale = row.iter().fold(0.0, |most: f64, x| most.max(x.abs())) / 127.0;
    let mut moves = Vec::new();
    for (k, x) in row.iter_mut().enumerate().filter(|_| scale > 0.0) {
        let scaled = *x / scale;
        if ((scaled - scaled.floor()) - 0.5).abs() < NEAR_TIE {
            moves.push((k, scale));
        }
        *x = scale * round(scaled);
    }
    moves
}
