//! Row-wise odds and ends, and how long arrays are cut to what a device binds at once.

use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::ops,
};
use std::ops::Range;

/// Bytes between the places where a slice of a tensor may start.
const SLICE: usize = 256;

/// Bytes that scratch of a row-wise step may take: large enough to fill any device, small beside the activations.
pub(super) const SCRATCH_BYTES: u64 = 256 << 20;

/// Cuts `rows` of tensors that have `widths` bytes a row, so that each part fits into one binding, stays modest as scratch
/// and can be sliced out of every one of those tensors.
pub(crate) fn row_chunks(rec: &Recorder, rows: usize, widths: &[usize]) -> impl Iterator<Item = Range<usize>> + use<> {
    let bytes = rec.limits().max_binding_bytes.min(SCRATCH_BYTES) as usize;
    let widest = widths.iter().copied().fold(1, usize::max);
    // Rows after which every tensor is back on a slice's boundary; powers of two, so the largest serves all.
    let aligned = |width: &usize| SLICE >> width.trailing_zeros().min(SLICE.trailing_zeros());
    let alignment = widths.iter().map(aligned).fold(1, usize::max);
    let step = (bytes / widest).max(alignment) / alignment * alignment;
    (0..rows).step_by(step).map(move |first| first..rows.min(first + step))
}

/// `target` `[len]` += `other` `[len]`.
pub fn add(rec: &mut Recorder, target: Tensor, other: Tensor, len: usize) {
    for part in row_chunks(rec, len, &[4]) {
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
    for part in row_chunks(rec, source_rows, &[4 * width]) {
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

/// `source` `[rows, width]` f16 as 8-bit integers, and `[rows]` f32 that 1 stands for in each row.
pub fn quantise_rows(rec: &mut Recorder, source: Tensor, rows: usize, width: usize) -> (Tensor, Tensor) {
    let (out, scales) = (rec.tensor::<u8>("quantised", rows * width), rec.tensor::<f32>("row_scales", rows));
    let kernel = ops::QuantiseRows { source, out, scales, rows: rows as u32, width: width as u32 };
    rec.dispatch_groups(kernel, rows);
    (out, scales)
}

/// `[rows, a]` and `[rows, b]` side by side as `[rows, a + b]` of type `output`.
pub fn join_columns(rec: &mut Recorder, rows: usize, parts: [(Tensor, usize); 2], output: Element) -> Tensor {
    let out_width = parts[0].1 + parts[1].1;
    let out = rec.tensor_of(output, "joined", rows * out_width);
    for part in row_chunks(rec, rows, &[4 * parts[0].1, 4 * parts[1].1, output.bytes() * out_width]) {
        let rows_of = |t: Tensor, width: usize| t.slice::<f32>(part.start * width, part.len() * width);
        for ((source, width), out_column) in parts.into_iter().zip([0, parts[0].1]) {
            let kernel = ops::PlaceColumns {
                source: rows_of(source, width),
                out: out.slice_of(output, part.start * out_width, part.len() * out_width),
                count: (part.len() * width) as u32,
                width: width as u32,
                out_width: out_width as u32,
                out_column: out_column as u32,
                output,
            };
            rec.dispatch(kernel, part.len() * width);
        }
    }
    out
}
