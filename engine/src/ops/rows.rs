use crate::{
    gpu::{Element, Limits, Recorder, Tensor},
    kernels::ops,
};
use std::ops::Range;

/// Device rows, `[count, width]`.
#[derive(Clone, Copy, Debug)]
pub struct Rows {
    pub tensor: Tensor,
    pub count: usize,
    pub width: usize,
    pub element: Element,
}

#[derive(Clone, Copy, Debug)]
pub struct Columns {
    pub of: Rows,
    pub first: usize,
    pub width: usize,
}

impl Rows {
    pub fn new(tensor: Tensor, count: usize, width: usize) -> Self {
        Self { tensor, count, width, element: Element::F32 }
    }

    pub fn scratch(rec: &mut Recorder, name: &str, count: usize, width: usize, element: Element) -> Self {
        Self { tensor: rec.tensor_of(element, name, count * width), count, width, element }
    }

    pub fn part(&self, rows: Range<usize>) -> Self {
        let tensor = self.tensor.slice_of(self.element, rows.start * self.width, rows.len() * self.width);
        Self { tensor, count: rows.len(), ..*self }
    }

    pub fn columns(&self, first: usize, width: usize) -> Columns {
        Columns { of: *self, first, width }
    }

    pub fn values(&self) -> usize {
        self.count * self.width
    }

    pub fn row_bytes(&self) -> usize {
        self.element.bytes() * self.width
    }
}

impl From<Rows> for Columns {
    fn from(rows: Rows) -> Self {
        rows.columns(0, rows.width)
    }
}

pub(super) const SLICE: usize = 256;

/// Fills any device, small next to the activations.
pub(super) const SCRATCH_BYTES: u64 = 256 << 20;

/// Rows between aligned slices, a power of two.
pub(super) fn aligned_rows(bytes: usize) -> usize {
    SLICE >> bytes.trailing_zeros().min(SLICE.trailing_zeros())
}

/// Subgroups per workgroup, a row each: one leaves large GPUs idle.
pub(super) fn row_subgroups(limits: &Limits) -> u32 {
    if limits.cpu { 1 } else { (128 / limits.subgroup_size).max(1) }
}

/// Every part is aligned and fits a binding and the budget.
pub(crate) fn row_chunks(rec: &Recorder, rows: usize, widths: &[usize]) -> impl Iterator<Item = Range<usize>> + use<> {
    let bytes = rec.limits().max_binding_bytes.min(SCRATCH_BYTES) as usize;
    let widest = widths.iter().copied().fold(1, usize::max);
    let alignment = widths.iter().copied().map(aligned_rows).fold(1, usize::max);
    let step = (bytes / widest).max(alignment) / alignment * alignment;
    (0..rows).step_by(step).map(move |first| first..rows.min(first + step))
}

pub fn add(rec: &mut Recorder, target: Rows, other: Rows) {
    for part in row_chunks(rec, target.values(), &[size_of::<f32>()]) {
        let [left, right] = [target, other].map(|rows| rows.tensor.slice::<f32>(part.start, part.len()));
        rec.dispatch(ops::Add { left, right, out: left, count: part.len() as u32 }, part.len());
    }
}

/// Gathers f32 rows `source[rows_from_out[i]]`.
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

/// From f16 to 8 bits and `[rows]` f32 scales.
pub fn quantize_rows(rec: &mut Recorder, source: Rows) -> (Rows, Tensor) {
    let Rows { count, width, .. } = source;
    let out = Rows::scratch(rec, "quantized", count, width, Element::I8);
    let scales = rec.tensor::<f32>("row_scales", count);
    let (rows, width) = (count as u32, width as u32);
    rec.dispatch_groups(ops::QuantizeRows { source: source.tensor, out: out.tensor, scales, rows, width }, count);
    (out, scales)
}

/// Writes f32 columns of `out` from `column`.
pub fn place_columns(rec: &mut Recorder, source: Rows, out: Rows, column: usize) {
    place_groups(rec, source, [0, 1, 1], out, column);
}

/// Writes f32 columns of `out`, from `column`, by `kept` rows from `first` of each `group`.
pub fn place_groups(rec: &mut Recorder, source: Rows, [first, kept, group]: [usize; 3], out: Rows, column: usize) {
    for part in row_chunks(rec, source.count / group, &[group * source.row_bytes(), kept * out.row_bytes()]) {
        let count = part.len() * kept * source.width;
        let kernel = ops::PlaceColumns {
            source: source.part(part.start * group..part.end * group).tensor,
            out: out.part(part.start * kept..part.end * kept).tensor,
            count: count as u32,
            width: source.width as u32,
            out_width: out.width as u32,
            out_column: column as u32,
            first: first as u32,
            kept: kept as u32,
            group: group as u32,
            output: out.element,
        };
        rec.dispatch(kernel, count);
    }
}

/// Concatenates f32 columns.
pub fn join_columns(rec: &mut Recorder, [left, right]: [Rows; 2], output: Element) -> Rows {
    let out = Rows::scratch(rec, "joined", left.count, left.width + right.width, output);
    place_columns(rec, left, out, 0);
    place_columns(rec, right, out, left.width);
    out
}
