//! Rows, what is done to them one by one, and how long arrays are cut to what a device binds at once.

use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::ops,
};
use std::ops::Range;

/// Rows of values on the device, `[count, width]`.
#[derive(Clone, Copy, Debug)]
pub struct Rows {
    /// The values.
    pub tensor: Tensor,
    /// Number of rows.
    pub count: usize,
    /// Values of a row.
    pub width: usize,
    /// Type of a value.
    pub element: Element,
}

/// Some neighbouring columns of rows.
#[derive(Clone, Copy, Debug)]
pub struct Columns {
    /// The whole rows.
    pub of: Rows,
    /// The first of the columns.
    pub first: usize,
    /// Number of columns.
    pub width: usize,
}

impl Rows {
    /// Rows of f32 in a tensor.
    pub fn new(tensor: Tensor, count: usize, width: usize) -> Self {
        Self { tensor, count, width, element: Element::F32 }
    }

    /// New rows in scratch memory.
    pub fn scratch(rec: &mut Recorder, name: &str, count: usize, width: usize, element: Element) -> Self {
        Self { tensor: rec.tensor_of(element, name, count * width), count, width, element }
    }

    /// The rows with these indices.
    pub fn part(&self, rows: Range<usize>) -> Self {
        let tensor = self.tensor.slice_of(self.element, rows.start * self.width, rows.len() * self.width);
        Self { tensor, count: rows.len(), ..*self }
    }

    /// `width` columns of every row, from `first` on.
    pub fn columns(&self, first: usize, width: usize) -> Columns {
        Columns { of: *self, first, width }
    }

    /// Values of all rows.
    pub fn values(&self) -> usize {
        self.count * self.width
    }

    /// Bytes of a row.
    pub fn row_bytes(&self) -> usize {
        self.element.bytes() * self.width
    }
}

impl From<Rows> for Columns {
    fn from(rows: Rows) -> Self {
        rows.columns(0, rows.width)
    }
}

/// Bytes between the places where a slice of a tensor may start.
pub(super) const SLICE: usize = 256;

/// Bytes that scratch of a row-wise step may take: large enough to fill any device, small beside the activations.
pub(super) const SCRATCH_BYTES: u64 = 256 << 20;

/// Rows of so many bytes after which a slice may start again, a power of two.
pub(super) fn aligned_rows(bytes: usize) -> usize {
    SLICE >> bytes.trailing_zeros().min(SLICE.trailing_zeros())
}

/// Cuts `rows` of tensors that have `widths` bytes a row, so that each part fits into one binding, stays modest as scratch
/// and can be sliced out of every one of those tensors.
pub(crate) fn row_chunks(rec: &Recorder, rows: usize, widths: &[usize]) -> impl Iterator<Item = Range<usize>> + use<> {
    let bytes = rec.limits().max_binding_bytes.min(SCRATCH_BYTES) as usize;
    let widest = widths.iter().copied().fold(1, usize::max);
    // Powers of two, so the largest serves all.
    let alignment = widths.iter().copied().map(aligned_rows).fold(1, usize::max);
    let step = (bytes / widest).max(alignment) / alignment * alignment;
    (0..rows).step_by(step).map(move |first| first..rows.min(first + step))
}

/// `target` += `other`, f32 of the same shape.
pub fn add(rec: &mut Recorder, target: Rows, other: Rows) {
    for part in row_chunks(rec, target.values(), &[size_of::<f32>()]) {
        let [left, right] = [target, other].map(|rows| rows.tensor.slice::<f32>(part.start, part.len()));
        rec.dispatch(ops::Add { left, right, out: left, count: part.len() as u32 }, part.len());
    }
}

/// The `count` rows `source[rows_from_out[i]]`, f32.
pub fn gather_rows(rec: &mut Recorder, source: Rows, rows_from_out: Tensor, count: usize) -> Rows {
    let out = Rows::scratch(rec, "gathered", count, source.width, Element::F32);
    for part in row_chunks(rec, source.count, &[source.row_bytes()]) {
        let kernel = ops::GatherRows {
            source: source.part(part.clone()).tensor,
            rows_from_out,
            out: out.tensor,
            count: count as u32,
            width: source.width as u32,
            first_row: part.start as u32,
            source_rows: part.len() as u32,
        };
        rec.dispatch(kernel, out.values());
    }
    out
}

/// f16 rows as 8-bit integers, and `[rows]` f32 that 1 stands for in each row.
pub fn quantise_rows(rec: &mut Recorder, source: Rows) -> (Rows, Tensor) {
    let Rows { count, width, .. } = source;
    let out = Rows::scratch(rec, "quantised", count, width, Element::I8);
    let scales = rec.tensor::<f32>("row_scales", count);
    let (rows, width) = (count as u32, width as u32);
    rec.dispatch_groups(ops::QuantiseRows { source: source.tensor, out: out.tensor, scales, rows, width }, count);
    (out, scales)
}

/// Writes f32 rows into columns of others of any type, from one on.
pub fn place_columns(rec: &mut Recorder, source: Rows, out: Rows, column: usize) {
    let kernel = ops::PlaceColumns {
        source: source.tensor,
        out: out.tensor,
        count: source.values() as u32,
        width: source.width as u32,
        out_width: out.width as u32,
        out_column: column as u32,
        output: out.element,
    };
    rec.dispatch(kernel, source.values());
}

/// f32 rows side by side, as rows of type `output`.
pub fn join_columns(rec: &mut Recorder, [left, right]: [Rows; 2], output: Element) -> Rows {
    let out = Rows::scratch(rec, "joined", left.count, left.width + right.width, output);
    for part in row_chunks(rec, out.count, &[left, right, out].map(|rows| rows.row_bytes())) {
        let out = out.part(part.clone());
        for (source, column) in [(left, 0), (right, left.width)] {
            place_columns(rec, source.part(part.clone()), out, column);
        }
    }
    out
}
