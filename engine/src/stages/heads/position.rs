//! Sinusoidal positions, on the host in f64.

use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    stages::ViewGrid,
};

const BASE: f64 = 100.0;
const SHARE: f64 = 0.1;

pub(super) struct Positions {
    /// Image width over height.
    aspect: f64,
    /// Height, width, channels.
    tables: Vec<([usize; 3], Tensor)>,
}

impl Positions {
    pub fn new(grid: ViewGrid) -> Self {
        Self { aspect: grid.columns as f64 / grid.rows as f64, tables: Vec::new() }
    }

    pub fn table(&mut self, rec: &mut Recorder, [height, width]: [usize; 2], channels: usize) -> Tensor {
        let shape = [height, width, channels];
        if let Some((_, tensor)) = self.tables.iter().find(|(other, _)| *other == shape) {
            return *tensor;
        }
        let tensor = rec.input::<f32>("positions", (height + width) * channels / 2);
        self.tables.push((shape, tensor));
        tensor
    }

    pub fn write(&self, run: &mut Run) -> Result<()> {
        self.tables.iter().try_for_each(|(shape, tensor)| run.write(*tensor, &position_table(self.aspect, *shape)))
    }
}

/// Returns position embeddings of `[height, width, channels]` as `[width + height, channels / 2]`:
/// columns for the first half of the channels, then lines.
///
/// The image's half diagonal is 1.
pub fn position_table(aspect: f64, [height, width, channels]: [usize; 3]) -> Vec<f32> {
    let diagonal = aspect.hypot(1.0);
    let axes = [(width, aspect / diagonal), (height, 1.0 / diagonal)];
    let mut table = Vec::with_capacity((height + width) * channels / 2);
    for (count, half) in axes {
        for i in 0..count {
            let place = half * (2.0 * i as f64 + 1.0 - count as f64) / count as f64;
            let angles = (0..channels / 4).map(|k| place * BASE.powf(-4.0 * k as f64 / channels as f64));
            table.extend(angles.clone().map(|angle| (SHARE * angle.sin()) as f32));
            table.extend(angles.map(|angle| (SHARE * angle.cos()) as f32));
        }
    }
    table
}
