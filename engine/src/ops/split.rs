use super::{Attention, AttentionKernel, Columns, Part, Pool, Rotary, Rows, rows::row_subgroups};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::ops,
};

/// Rows that [`Attention::split`] writes.
#[derive(Clone, Copy)]
struct Written {
    rows: usize,
    first_row: usize,
    sequences: usize,
    /// Rows per sequence.
    sequence: usize,
    pool: Option<Pool>,
    log_counts: Option<Tensor>,
}

impl Attention {
    /// Copies a part from projection columns into `out`, starting at row `first_row` of all
    /// sequences.
    pub fn split(&self, rec: &mut Recorder, projection: impl Into<Columns>, first_row: usize, part: Part, out: Tensor) {
        let columns = projection.into();
        let of_keys = part.keys || part.scale == 0.0;
        let out = if of_keys && self.common_keys > 0 {
            let at = self.own_first(rec.limits()) * self.channels();
            let bytes = self.kernel.element().bytes();
            out.slice::<u8>(at * bytes, out.bytes() as usize - at * bytes)
        } else {
            out
        };
        let sequence = if of_keys { self.keys } else { self.queries };
        let written = Written {
            rows: columns.of.count,
            first_row,
            sequences: self.sequences,
            sequence,
            pool: None,
            log_counts: None,
        };
        self.write_rows(rec, columns, written, part, out);
    }

    /// Copies common keys or values of whole views from `view` on.
    pub fn split_common(
        &self,
        rec: &mut Recorder,
        projection: Columns,
        pool: Pool,
        view: usize,
        part: Part,
        [out, log_counts]: [Tensor; 2],
    ) {
        let (unit, count) = (pool.tokens(), projection.of.count);
        // The first view may be unpooled.
        let first = if view == 0 && pool.first { unit } else { 0 };
        for (side, rows) in [(1, 0..first), (pool.side, first..count)].into_iter().filter(|(_, rows)| !rows.is_empty())
        {
            let view = view + rows.start / unit;
            let first_row = pool.keys_of(view * unit);
            let written = Written {
                rows: pool.keys_of(view * unit + rows.len()) - first_row,
                first_row,
                sequences: 1,
                sequence: self.common_keys,
                pool: Some(Pool { side, ..pool }),
                log_counts: part.keys.then_some(log_counts),
            };
            let Columns { of, first, width } = projection;
            self.write_rows(rec, Columns { of, first: first + rows.start * of.width, width }, written, part, out);
        }
    }

    fn write_rows(&self, rec: &mut Recorder, projection: Columns, written: Written, part: Part, out: Tensor) {
        let Written { rows, first_row, sequences, sequence, pool, log_counts } = written;
        let Columns { of: Rows { tensor: projection, width: stride, .. }, first: column, .. } = projection;
        let (norm_weight, norm_bias, eps) =
            part.norm.map_or((projection, projection, 0.0), |n| (n.weight, n.bias, n.eps));
        let Rotary { table, tokens, turned } = part.rotary.unwrap_or(Rotary {
            table: projection,
            tokens: pool.map_or(1, |pool| pool.tokens()),
            turned: 0,
        });
        let limits = rec.limits();
        let panel = if self.is_uniform(limits) { self.panel(limits) } else { sequence.next_multiple_of(4) };
        let subgroups = row_subgroups(limits);
        let kernel = ops::SplitHeads {
            projection,
            weight: norm_weight,
            bias: norm_bias,
            rotary: table,
            out,
            log_counts: log_counts.unwrap_or(out),
            rows: rows as u32,
            heads: self.heads.count as u32,
            dim: self.heads.dim as u32,
            out_dim: self.channels() as u32,
            stride: stride as u32,
            column: column as u32,
            first_row: first_row as u32,
            out_rows: (sequences * sequence) as u32,
            sequence: sequence as u32,
            panel: panel as u32,
            tokens: tokens as u32,
            turned: turned as u32,
            columns: pool.map_or(1, |pool| pool.grid[1]) as u32,
            leading: pool.map_or(0, |pool| pool.leading) as u32,
            views: self.sequences as u32,
            scale: if part.scale == 0.0 { 1.0 } else { part.scale },
            eps,
            norm: part.norm.is_some(),
            rotate: part.rotary.is_some(),
            pool: pool.map_or(1, |pool| pool.side) as u32,
            count: log_counts.is_some(),
            own: pool.is_some_and(|pool| pool.own),
            first: pool.is_some_and(|pool| pool.first),
            transpose: part.keys && matches!(self.kernel, AttentionKernel::Lanes(_)),
            subgroups,
            element: self.kernel.element(),
        };
        rec.dispatch_groups(kernel, (rows * self.heads.count).div_ceil(subgroups as usize));
    }
}
