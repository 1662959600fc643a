//! Palettes by repeated splitting of the cell with the largest variance, after Heckbert 1982.

use std::collections::BinaryHeap;
use std::ops::Range;

use rayon::prelude::*;

/// Centers `[cells, width]`, and each row's cell.
pub(super) struct Palette {
    pub centers: Vec<f32>,
    pub labels: Vec<u16>,
}

impl Palette {
    /// Divides rows of `width` values into at most `most` cells. Equal rows share a cell.
    pub(super) fn of(values: &[f32], width: usize, most: usize) -> Self {
        let row = |i: u32| &values[i as usize * width..][..width];
        let mut order: Vec<u32> = (0..(values.len() / width) as u32).collect();
        let mut cells = vec![(0..order.len(), spread(&order, width, row))];
        // Positive squares order like their bits.
        let mut queue = BinaryHeap::from([(cells[0].1.squares.to_bits(), 0)]);
        while cells.len() < most
            && let Some((1.., cell)) = queue.pop()
        {
            let (Range { start, end }, Spread { axis, mean, .. }) = cells[cell].clone();
            let (low, high): (Vec<u32>, Vec<u32>) =
                order[start..end].iter().partition(|i| f64::from(row(**i)[axis]) <= mean);
            let middle = start + low.len();
            order[start..middle].copy_from_slice(&low);
            order[middle..end].copy_from_slice(&high);
            let halves = [start..middle, middle..end].map(|half| (half.clone(), spread(&order[half], width, row)));
            let [low, high] = halves;
            queue.extend([(low.1.squares.to_bits(), cell), (high.1.squares.to_bits(), cells.len())]);
            cells[cell] = low;
            cells.push(high);
        }
        let mut labels = vec![0; order.len()];
        for (cell, (range, _)) in cells.iter().enumerate() {
            order[range.clone()].iter().for_each(|i| labels[*i as usize] = cell as u16);
        }
        let center = |(range, _): &(Range<usize>, Spread)| {
            let mean = |d: usize| {
                let sum: f64 = order[range.clone()].iter().map(|i| f64::from(row(*i)[d])).sum();
                (sum / range.len().max(1) as f64) as f32
            };
            (0..width).map(mean).collect::<Vec<f32>>()
        };
        Self { centers: cells.par_iter().flat_map_iter(center).collect(), labels }
    }
}

#[derive(Clone)]
struct Spread {
    axis: usize,
    mean: f64,
    squares: f64,
}

/// Returns the axis with the largest sum of squared deviations.
fn spread<'a>(part: &[u32], width: usize, row: impl Fn(u32) -> &'a [f32] + Sync) -> Spread {
    let of = |axis: usize| {
        let value = |i: &u32| f64::from(row(*i)[axis]);
        let mean = part.iter().map(value).sum::<f64>() / part.len().max(1) as f64;
        let (least, most) = part.iter().map(value).fold((mean, mean), |(a, b), x| (a.min(x), b.max(x)));
        // Rounding of the mean must not split equal values.
        let squares = if least < most { part.iter().map(|i| (value(i) - mean).powi(2)).sum() } else { 0.0 };
        Spread { axis, mean: mean.min(most), squares }
    };
    let larger = |a: Spread, b: Spread| if b.squares > a.squares { b } else { a };
    (0..width).into_par_iter().map(of).reduce_with(larger).expect("at least one axis")
}
