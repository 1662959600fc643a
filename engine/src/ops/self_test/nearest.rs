//! Nearest rows on matrix units against those on lanes.

use super::{SelfTest, noise};
use crate::{
    Result,
    gpu::{Device, Element, Recorder, Run},
    ops::{Nearest, NearestKernel, NearestTile, Tiles, Units},
};

/// Name of the kernel.
pub(super) const NAME: &str = "cluster/nearest_matrix_f16";

/// How much farther what is found may be, in squared distance and relative to its rms: some times what its sums are off, where
/// one of both sees a tie.
const LIMIT: f64 = 1e-5 + Nearest::TIE as f64;

impl SelfTest {
    /// Every tile.
    pub(super) fn nearest_tiles(&mut self, device: &Device, units: Units) -> Result<()> {
        let tiles = NearestTile::candidates(device.limits(), units);
        self.none_fits(NAME, tiles.is_empty());
        tiles.iter().enumerate().try_for_each(|(index, tile)| self.nearest_tile(device, units, *tile, index))
    }

    /// Several workgroups each way, the last of them not whole.
    pub(super) fn nearest_tile(
        &mut self,
        device: &Device,
        units: Units,
        tile: NearestTile,
        index: usize,
    ) -> Result<()> {
        let [points, targets] = tile.sides(units.shape);
        let units = Units { tiles: Tiles::always(index), ..units };
        self.nearest(device, units, 4 * points + 3, 2 * targets + 6)
    }

    /// How far the targets are that are found nearest. Points lie nearly midway between two, which only the low halves tell
    /// apart.
    fn nearest(&mut self, device: &Device, units: Units, points: usize, targets: usize) -> Result<()> {
        const WIDTH: usize = 76;
        let [mut from, to] = [(1, points), (2, targets)].map(|(seed, rows)| noise(seed, rows, WIDTH, Element::F32));
        for (i, x) in from.iter_mut().enumerate() {
            let at = i / WIDTH % (targets - 1) * WIDTH + i % WIDTH;
            *x = 0.5 * (to[at] + to[at + WIDTH]) + *x / 2048.0;
        }
        let distances = |kernel: NearestKernel| -> Result<Vec<f32>> {
            let mut rec = Recorder::new(device.limits());
            let [points, targets] = [&from, &to].map(|rows| (rec.input::<f32>("rows", rows.len()), rows.len() / WIDTH));
            let nearest = Nearest::among(&mut rec, kernel, targets, WIDTH);
            let rows = [points, targets].map(|rows| nearest.rows(&mut rec, rows));
            let out = nearest.record(&mut rec, rows[0], rows[1]);
            rec.output(out);
            let mut run = Run::new(device, rec.finish()?)?;
            run.write(points.0, &from)?;
            run.write(targets.0, &to)?;
            run.execute()?;
            let squared = |(point, index): (&[f32], u32)| {
                let target = to.chunks(WIDTH).nth(index as usize).unwrap_or(&[f32::NAN; WIDTH]);
                let squares = point.iter().zip(target).map(|(p, t)| f64::from(p - t).powi(2));
                squares.sum::<f64>() as f32
            };
            Ok(from.chunks(WIDTH).zip(run.read(out)?).map(squared).collect())
        };
        self.outcome(NAME, |test| {
            let (exact, fast) = (distances(NearestKernel::Lanes)?, distances(NearestKernel::Matrix(units))?);
            test.compare(NAME, LIMIT, 0.0, &exact, &fast);
            Ok(())
        })
    }
}
