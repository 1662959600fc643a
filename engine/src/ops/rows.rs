//! Row-wise odds and ends, and how long arrays are cut to what a device binds at once.

use crate::{
    gpu::{Recorder, Tensor},
    kernels::ops,
};
use std::ops::Range;

/// Rows start on multiples of this, which keeps every slice on a 256-byte boundary for widths of whole f32.
const ROW_ALIGNMENT: usize = 64;

/// Bytes that scratch of a row-wise step may take: large enough to fill any device, small beside the activations.
pub(super) const SCRATCH_BYTES: u64 = 256 << 20;

/// Cuts `rows` so that `width` f32 a row fit into one binding and stay modest as scratch.
pub(crate) fn row_chunks(rec: &Recorder, rows: usize, width: usize) -> impl Iterator<Item = Range<usize>> + use<> {
    let bytes = rec.limits().max_binding_bytes.min(SCRATCH_BYTES);
    let step = (bytes as usize / (4 * width)).max(ROW_ALIGNMENT) / ROW_ALIGNMENT * ROW_ALIGNMENT;
    (0..rows).step_by(step).map(move |first| first..rows.min(first + step))
}

/// `target` `[len]` += `other` `[len]`.
pub fn add(rec: &mut Recorder, target: Tensor, other: Tensor, len: usize) {
    for part in row_chunks(rec, len, 1) {
        let left = target.slice::<f32>(part.start, part.len());
        let right = other.slice::<f32>(part.start, part.len());
        rec.dispatch(ops::Add { left, right, out: left, count: part.len() as u32 }, part.len());
    }
}

/// `out[i] = source[rows_from_out[i]]` for `count` rows of `width` f32; the source has `source_rows`.
pub fn gather_rows(
    rec: &mut Recorder,
    source: Tensor,
    source_rows: usize,
    rows_from_out: Tensor,
    count: usize,
    width: usize,
) -> Tensor {
    let out = rec.tensor::<f32>("gathered", count * width);
    for part in row_chunks(rec, source_rows, width) {
        let kernel = ops::GatherRows {
            source: source.slice::<f32>(part.start * width, part.len() * width),
            rows_from_out,
            out,
            count: count as u32,
            width: width as u32,
            first_row: part.start as u32,
            source_rows: part.len() as u32,
        };
        rec.dispatch(kernel, count * width);
    }
    out
}

/// `[rows, a]` and `[rows, b]` side by side as `[rows, a + b]`.
pub fn join_columns(rec: &mut Recorder, rows: usize, parts: [(Tensor, usize); 2]) -> Tensor {
    let out_width = parts[0].1 + parts[1].1;
    let out = rec.tensor::<f32>("joined", rows * out_width);
    let mut out_column = 0;
    for (source, width) in parts {
        let kernel = ops::PlaceColumns {
            source,
            out,
            count: (rows * width) as u32,
            width: width as u32,
            out_width: out_width as u32,
            out_column: out_column as u32,
        };
        rec.dispatch(kernel, rows * width);
        out_column += width;
    }
    out
}
