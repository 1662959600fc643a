//! Features of a scene, reduced for the page.

use nalgebra::{DMatrix, DMatrixView};
use serde::Serialize;
use zipsplat::features::Lifted;

/// Most channels in the page.
const CHANNELS: usize = 16;
/// Rows that the principal components are computed from, evenly spaced.
const SAMPLE: usize = 4096;
const ITERATIONS: usize = 16;

/// Rows of about the lifted features' cosine similarities.
#[derive(Serialize)]
pub struct ShownFeatures {
    channels: usize,
    /// Signed. Rows of zeros have no features.
    #[serde(skip)]
    pub bytes: Vec<u8>,
}

impl ShownFeatures {
    pub fn new(lifted: &Lifted) -> Self {
        let (channels, count) = (lifted.features.channels, lifted.weights.len());
        let rows = DMatrixView::from_slice(&lifted.features.values, channels, count);
        let seen: Vec<usize> =
            (0..count).filter(|i| lifted.weights[*i] > 0.0 && rows.column(*i).amax() > 0.0).collect();
        let basis = if channels <= CHANNELS {
            DMatrix::identity(channels, channels)
        } else {
            let sampled: Vec<usize> = seen.iter().copied().step_by(seen.len().div_ceil(SAMPLE).max(1)).collect();
            components(DMatrix::from_fn(channels, sampled.len(), |c, i| rows[(c, sampled[i])]))
        };
        let channels = basis.ncols();
        let mut bytes = vec![0; count * channels];
        for i in seen {
            let row = basis.tr_mul(&rows.column(i));
            let scale = 127.0 / row.amax();
            let to = &mut bytes[i * channels..][..channels];
            to.iter_mut().zip(&row).for_each(|(to, value)| *to = (value * scale).round() as i8 as u8);
        }
        Self { channels, bytes }
    }
}

/// Principal components of columns' directions, by subspace iteration. Cosine similarities need
/// the mean, which stays.
fn components(mut columns: DMatrix<f32>) -> DMatrix<f32> {
    columns.column_iter_mut().for_each(|mut column| {
        column.normalize_mut();
    });
    // Pseudorandom: no component is orthogonal to it.
    let mut basis = DMatrix::from_fn(columns.nrows(), CHANNELS, |i, j| ((i * CHANNELS + j) as f32).powi(2).sin());
    for _ in 0..ITERATIONS {
        basis = (&columns * columns.tr_mul(&basis)).qr().q();
    }
    basis
}
