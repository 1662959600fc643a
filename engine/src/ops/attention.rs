use super::{
    Norm, Rows, Tile, Units,
    rows::SLICE,
    tile::choose,
    uniform::{attention_tile, terms_of},
};
use crate::{
    gpu::{Element, Kernel, Limits, Recorder, Tensor},
    kernels::{limits::ATTENTION_ROWS, ops},
};

/// Sets the fields common to attention kernels.
macro_rules! attention_kernel {
    ($kernel:ident, $attention:ident, $limits:expr, $tensors:ident, $out:ident, { $($own:tt)* }) => {{
        let [q, k, v, log_counts] = $tensors;
        ops::$kernel {
            q,
            k,
            v,
            log_counts,
            out: $out,
            queries: $attention.queries as u32,
            keys: $attention.keys as u32,
            sequences: $attention.sequences as u32,
            heads: $attention.heads.count as u32,
            common_keys: $attention.common_keys as u32,
            own_first: $attention.own_first($limits) as u32,
            dim: $attention.heads.dim as u32,
            pooled: $attention.common_keys > 0,
            $($own)*
        }
    }};
}

#[derive(Clone, Copy, Debug)]
pub struct Heads {
    pub count: usize,
    pub dim: usize,
}

impl Heads {
    pub fn new(count: usize, width: usize) -> Self {
        Self { count, dim: width / count }
    }

    pub fn width(&self) -> usize {
        self.count * self.dim
    }
}

/// Processing of projected queries, keys or values.
#[derive(Clone, Copy, Debug, Default)]
pub struct Part {
    /// Norm per head.
    pub norm: Option<Norm>,
    pub rotary: Option<Rotary>,
    /// Whether these are keys, transposed on lanes.
    pub keys: bool,
    /// Scale; 0 for none.
    pub scale: f32,
}

/// Rotary embedding, the same for every view.
#[derive(Clone, Copy, Debug)]
pub struct Rotary {
    /// `[turned, dim / 2, 2]` f32: cosine and sine per channel pair.
    pub table: Tensor,
    /// Per view.
    pub tokens: usize,
    /// Leading tokens that rotate.
    pub turned: usize,
}

#[derive(Clone, Copy, Debug)]
pub struct Attention {
    pub heads: Heads,
    pub sequences: usize,
    /// Per sequence.
    pub queries: usize,
    /// Of all sequences.
    pub common_keys: usize,
    /// Of each sequence besides.
    pub keys: usize,
    pub kernel: AttentionKernel,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttentionKernel {
    /// ops/attention or ops/attention_uniform, with keys in panels.
    Lanes(Element),
    /// ops/attention_matrix, 16-bit, heads padded to whole matrices.
    Matrix(Units),
}

impl AttentionKernel {
    pub fn element(self) -> Element {
        match self {
            AttentionKernel::Lanes(element) | AttentionKernel::Matrix(Units { factor: element, .. }) => element,
        }
    }
}

impl Attention {
    /// Allocates queries, keys, values and `[sequences, common_keys]` f32, terms of common keys'
    /// scores. Without common keys, the last aliases the keys.
    pub fn tensors(&self, rec: &mut Recorder) -> [Tensor; 4] {
        let (limits, channels) = (rec.limits(), self.channels());
        let own = |keys: usize| (self.own_first(limits) + self.heads.count * self.sequences * keys) * channels;
        let queries = self.heads.count * self.sequences * self.queries;
        let (queries, keys) = match self.kernel {
            AttentionKernel::Lanes(_) => (queries, self.padded(limits, self.keys)),
            // The last workgroup overruns the queries.
            AttentionKernel::Matrix(units) => {
                let tiles = Tile::attention(limits, units, 8);
                (queries + tiles.iter().map(|tile| tile.sides(units)[0]).max().unwrap_or(0), self.keys)
            }
        };
        let element = self.kernel.element();
        let lens = [("queries", queries * channels), ("keys", own(keys)), ("values", own(self.keys))];
        let [q, k, v] = lens.map(|(name, len)| rec.tensor_of(element, name, len));
        let log_counts = self.sequences * self.common_keys;
        [q, k, v, if log_counts > 0 { rec.tensor::<f32>("log_counts", log_counts) } else { k }]
    }

    /// Keys with padding.
    fn padded(&self, limits: &Limits, keys: usize) -> usize {
        match self.kernel {
            AttentionKernel::Lanes(_) if self.is_uniform(limits) => keys.next_multiple_of(self.panel(limits)),
            AttentionKernel::Lanes(_) => keys.next_multiple_of(4),
            AttentionKernel::Matrix(_) => keys,
        }
    }

    /// Row of the sequences' own keys behind the common ones, where a slice may start.
    pub(super) fn own_first(&self, limits: &Limits) -> usize {
        (self.heads.count * self.padded(limits, self.common_keys)).next_multiple_of(SLICE)
    }

    pub(super) fn channels(&self) -> usize {
        match self.kernel {
            AttentionKernel::Lanes(_) => self.heads.dim,
            AttentionKernel::Matrix(Units { shape, .. }) => {
                self.heads.dim.next_multiple_of(shape.n.max(shape.k) as usize)
            }
        }
    }

    pub fn scale(&self) -> f32 {
        1.0 / (self.heads.dim as f32).sqrt()
    }

    /// Returns softmax(q k) v, `[sequences * queries, width]`.
    pub fn record(&self, rec: &mut Recorder, tensors: [Tensor; 4]) -> Rows {
        let rows = self.sequences * self.queries;
        let out = Rows::scratch(rec, "attended", rows, self.heads.width(), self.kernel.element());
        match self.kernel {
            AttentionKernel::Lanes(_) if self.is_uniform(rec.limits()) => self.uniform(rec, tensors, out.tensor),
            AttentionKernel::Lanes(element) => self.lanes(rec, element, tensors, out.tensor),
            AttentionKernel::Matrix(units) => self.matrix(rec, units, tensors, out.tensor),
        }
        out
    }

    pub(super) fn panel(&self, limits: &Limits) -> usize {
        (attention_tile(limits)[1] * limits.subgroup_size) as usize
    }

    pub(super) fn is_uniform(&self, limits: &Limits) -> bool {
        let [queries, lanes] = [attention_tile(limits)[0], limits.subgroup_size].map(|n| n as usize);
        limits.addresses
            && self.kernel.element() == Element::F32
            && self.heads.dim.is_multiple_of(lanes)
            && self.queries.div_ceil(queries) <= limits.max_groups[0] as usize
    }

    fn uniform(&self, rec: &mut Recorder, tensors: [Tensor; 4], out: Tensor) {
        let [tile_rows, key_vectors] = attention_tile(rec.limits());
        let kernel = attention_kernel!(AttentionUniform, self, rec.limits(), tensors, out, {
            vectors: self.heads.dim as u32 / rec.limits().subgroup_size,
            terms: terms_of(self.heads.dim).min(16),
            tile_rows,
            key_vectors,
        });
        self.dispatch(rec, kernel, tile_rows as usize);
    }

    fn lanes(&self, rec: &mut Recorder, element: Element, tensors: [Tensor; 4], out: Tensor) {
        let (dim, channels_at_once) = (self.heads.dim as u32, 4 * rec.limits().subgroup_size);
        let kernel = attention_kernel!(Attention, self, rec.limits(), tensors, out, {
            vectors: dim.div_ceil(channels_at_once),
            parts: 1 << (channels_at_once / dim).max(1).ilog2(),
            element,
        });
        self.dispatch(rec, kernel, ATTENTION_ROWS as usize);
    }

    fn matrix(&self, rec: &mut Recorder, units: Units, tensors: [Tensor; 4], out: Tensor) {
        let tile = self.tile(rec.limits(), units);
        let Units { factor, shape, .. } = units;
        macro_rules! dispatch {
            ($kernel:ident) => {{
                let kernel = attention_kernel!($kernel, self, rec.limits(), tensors, out, {
                    subgroups: tile.subgroups[0],
                    matrix_m: shape.m,
                    matrix_n: shape.n,
                    matrix_k: shape.k,
                    repeat_m: tile.repeats[0],
                    tile: tile.k,
                    channels: self.channels() as u32,
                    cpu: rec.limits().cpu,
                    factor,
                });
                self.dispatch(rec, kernel, tile.sides(units)[0]);
            }};
        }
        if rec.limits().matrices.conversions && shape.n == shape.k {
            dispatch!(AttentionConverting);
        } else {
            dispatch!(AttentionMatrix);
        }
    }

    fn tile(&self, limits: &Limits, units: Units) -> Tile {
        let (channels, heads) = (self.channels(), self.heads.count * self.sequences);
        let candidates = Tile::attention(limits, units, channels);
        let tuned = Tile::attention(limits, units, Tile::TUNED_CHANNELS);
        let measured = units.tiles.of(self.queries * heads * channels).and_then(|index| tuned.get(index));
        let measured = measured.and_then(|tile| candidates.iter().position(|candidate| candidate == tile));
        let by_rule = candidates.iter().take_while(|tile| tile.repeats == candidates[0].repeats).count();
        choose(&candidates, measured, by_rule, |tile| self.queries.div_ceil(tile.sides(units)[0]) * heads)
    }

    fn dispatch<K: Kernel>(&self, rec: &mut Recorder, kernel: K, rows: usize) {
        let groups = [self.queries.div_ceil(rows), self.heads.count, self.sequences];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops());
    }

    fn flops(&self) -> u64 {
        (4 * self.sequences * self.queries * (self.common_keys + self.keys) * self.heads.width()) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::{Arithmetic, ParameterLayout, Tiles};

    #[test]
    fn heads_too_wide_for_registers_take_lanes() {
        let limits = Limits::default();
        let attention = Units::of(Element::F16, &limits);
        let kernel = |dim: usize| {
            let arithmetic = Arithmetic { attention, ..Arithmetic::EXACT };
            ParameterLayout::new(&limits, arithmetic).attention(Heads { count: 1, dim })
        };
        let widest = Tile::MOST_CHANNELS;
        assert!(
            matches!(kernel(widest), AttentionKernel::Matrix(units) if !Tile::attention(&limits, units, widest).is_empty())
        );
        assert_eq!(kernel(widest + 4), AttentionKernel::Lanes(Element::F32));
    }

    #[test]
    fn few_queries_get_small_tiles_and_only_measuring_gets_one_matrix_a_subgroup() {
        let limits = Limits::default();
        let units = Units::of(Element::F16, &limits).expect("an ordinary device has matrix units");
        let choose = |units, queries, count, dim| {
            let kernel = AttentionKernel::Matrix(units);
            Attention { heads: Heads { count, dim }, sequences: 1, queries, common_keys: 0, keys: 1, kernel }
                .tile(&limits, units)
        };
        let tiles = Tile::attention(&limits, units, Tile::TUNED_CHANNELS);
        assert_eq!([(1, 1), (60_000, 24)].map(|(q, h)| choose(units, q, h, 64).subgroups), [[1, 1], [2, 1]]);
        assert!([(1, 1), (300, 16), (60_000, 24)].iter().all(|&(q, h)| choose(units, q, h, 64).repeats == [2, 1]));
        assert!(tiles.iter().any(|tile| tile.repeats == [1, 1]));
        for (index, tile) in tiles.iter().enumerate() {
            let units = Units { tiles: Tiles::always(index), ..units };
            assert_eq!([16, 64].map(|channels| choose(units, 300, 16, channels)), [*tile; 2]);
        }
    }
}
