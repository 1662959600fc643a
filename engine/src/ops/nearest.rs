use super::{
    Rows, Tile, Units,
    tile::choose,
    uniform::{UNIFORM_TILE, divides_panels, terms_of},
};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{
        cluster as kernels,
        limits::{NEAREST_ROWS, PANEL_COLUMNS},
    },
};

const ORIGIN_ROWS: usize = 256;

const SHARES: usize = 8;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NearestKernel {
    /// cluster/nearest or cluster/nearest_uniform: f32 differences.
    Lanes,
    /// cluster/nearest_matrix: split-f16 products about an origin.
    Matrix(Units),
}

/// Search by squared Euclidean distance.
#[derive(Clone, Copy, Debug)]
pub struct Nearest {
    /// Matrix units and the origin, unless on lanes.
    matrix: Option<(Units, Tensor)>,
    width: usize,
}

#[derive(Clone, Copy, Debug)]
pub struct NearestRows {
    rows: Tensor,
    /// f32, panels or f16 pairs.
    values: Tensor,
    scales: Tensor,
    norms: Tensor,
    count: usize,
}

impl Nearest {
    /// Relative distance of ties, well above rounding.
    pub const TIE: f32 = 1.0 / 65536.0;

    /// The origin is the mean of `sample`, whose width is a multiple of 4.
    pub fn among(rec: &mut Recorder, kernel: NearestKernel, sample: Rows) -> Self {
        let Rows { tensor: source, count, width, .. } = sample;
        let NearestKernel::Matrix(units) = kernel else { return Self { matrix: None, width } };
        let origin = rec.tensor::<f32>("origin", width);
        let kernel = kernels::Origin {
            source,
            out: origin,
            rows: count as u32,
            width: width as u32,
            samples: count.clamp(1, ORIGIN_ROWS) as u32,
        };
        rec.dispatch(kernel, width / 4);
        Self::about(origin, units, width)
    }

    /// `origin` is `[width]` f32; errors grow with distance from it.
    pub fn about(origin: Tensor, units: Units, width: usize) -> Self {
        Self { matrix: Some((units, origin)), width }
    }

    /// Origin `[width]` f32, if used.
    pub fn origin(&self) -> Option<Tensor> {
        self.matrix.map(|(_, origin)| origin)
    }

    pub fn rows(&self, rec: &mut Recorder, Rows { tensor: rows, count, .. }: Rows) -> NearestRows {
        let Some((_, origin)) = self.matrix else {
            let values = if divides_panels(rec.limits()) { self.panels(rec, rows, count) } else { rows };
            return NearestRows { rows, values, scales: rows, norms: rows, count };
        };
        let halves = rec.tensor::<[u16; 2]>("halves", count * self.width.next_multiple_of(8));
        let [scales, norms] = ["scales", "norms"].map(|name| rec.tensor::<f32>(name, count.next_multiple_of(4)));
        let kernel = kernels::Halves {
            source: rows,
            origin,
            out: halves,
            scales,
            norms,
            rows: count as u32,
            width: self.width as u32,
        };
        rec.dispatch_groups(kernel, count);
        NearestRows { rows, values: halves, scales, norms, count }
    }

    /// Returns nearest targets, `[points]` u32. Ties ([`Nearest::TIE`]) go to the first.
    pub fn record(&self, rec: &mut Recorder, points: NearestRows, targets: NearestRows) -> Tensor {
        let out = rec.tensor::<u32>("nearest", points.count);
        self.record_into(rec, points, targets, out);
        out
    }

    pub fn record_into(&self, rec: &mut Recorder, points: NearestRows, targets: NearestRows, out: Tensor) {
        match self.matrix {
            None if divides_panels(rec.limits()) => self.uniform(rec, points, targets, out),
            None => self.lanes(rec, points, targets, out),
            Some((units, _)) => self.matrix(rec, units, points, targets, out),
        }
    }

    fn panels(&self, rec: &mut Recorder, rows: Tensor, count: usize) -> Tensor {
        let values = count.next_multiple_of(PANEL_COLUMNS as usize) * self.width;
        let out = rec.tensor::<f32>("panels", values);
        rec.dispatch(kernels::Panels { source: rows, out, rows: count as u32, width: self.width as u32 }, values);
        out
    }

    fn uniform(&self, rec: &mut Recorder, points: NearestRows, targets: NearestRows, out: Tensor) {
        let [tile_rows, vectors] = UNIFORM_TILE;
        let kernel = kernels::NearestUniform {
            points: points.values,
            targets: targets.rows,
            out,
            point_count: points.count as u32,
            target_count: targets.count as u32,
            width: self.width as u32,
            tie: Self::TIE,
            terms: terms_of(self.width),
            tile_rows,
            vectors,
        };
        let groups = points.count.div_ceil((vectors * rec.limits().subgroup_size) as usize);
        rec.dispatch_groups(kernel, groups).flops(self.flops(points, targets));
    }

    fn lanes(&self, rec: &mut Recorder, points: NearestRows, targets: NearestRows, out: Tensor) {
        let kernel = kernels::Nearest {
            points: points.values,
            targets: targets.values,
            out,
            point_count: points.count as u32,
            target_count: targets.count as u32,
            width: self.width as u32,
            tie: Self::TIE,
        };
        let groups = points.count.div_ceil(NEAREST_ROWS as usize);
        rec.dispatch_groups(kernel, groups).flops(self.flops(points, targets));
    }

    fn matrix(&self, rec: &mut Recorder, units: Units, points: NearestRows, targets: NearestRows, out: Tensor) {
        let candidates = Tile::nearest(rec.limits(), units);
        let workgroups = |tile: &Tile| {
            let [tile_points, tile_targets] = tile.sides(units);
            points.count.div_ceil(tile_points) * targets.count.div_ceil(tile_targets).min(SHARES)
        };
        let measured = units.tiles.of(points.count * targets.count);
        let tile = choose(&candidates, measured, candidates.len(), workgroups);
        let [tile_points, tile_targets] = tile.sides(units);
        let share = targets.count.div_ceil(SHARES).next_multiple_of(tile_targets);
        let shares = targets.count.div_ceil(share);
        let candidates = rec.tensor::<[u32; 4]>("candidates", shares * points.count);
        let kernel = kernels::NearestMatrix {
            points: points.values,
            point_scales: points.scales,
            targets: targets.values,
            target_scales: targets.scales,
            target_norms: targets.norms,
            candidates,
            point_count: points.count as u32,
            column_count: targets.count as u32,
            pieces: self.width.div_ceil(8) as u32,
            share: share as u32,
            subgroups: tile.all_subgroups(),
            subgroups_n: tile.subgroups[1],
            matrix_m: units.shape.m,
            matrix_n: units.shape.n,
            matrix_k: units.shape.k,
            repeat_m: tile.repeats[0],
            repeat_n: tile.repeats[1],
            tile_k: tile.k,
            factor: units.factor,
        };
        // Shares vary fastest, so that workgroups share points in cache.
        let groups = [shares, points.count.div_ceil(tile_points), 1];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(points, targets));
        let merge = kernels::NearestMerge {
            points: points.rows,
            targets: targets.rows,
            norms: points.norms,
            candidates,
            out,
            point_count: points.count as u32,
            width: self.width as u32,
            shares: shares as u32,
            tie: Self::TIE,
        };
        rec.dispatch_groups(merge, points.count);
    }

    fn flops(&self, points: NearestRows, targets: NearestRows) -> u64 {
        (2 * points.count * targets.count * self.width) as u64
    }
}
