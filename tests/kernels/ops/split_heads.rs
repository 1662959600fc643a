//! Heads out of a projection: where every value goes exactly, and what norm and rotation make of it.

use crate::case::{Case, elements, random, stored};
use zipsplat::{gpu::Element, kernels::ops::SplitHeads, stages::backbone::rotary_tables};
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::reference::{
    backbone::rope::{global_positions, local_positions},
    ops::split_heads::{Part, split_heads},
    widen,
};

/// One call of the kernel: `rows` rows from `first_row` on, of sequences of `sequence` rows.
#[derive(Clone, Copy, Debug)]
struct Call {
    heads: usize,
    dim: usize,
    rows: usize,
    first_row: usize,
    out_rows: usize,
    sequence: usize,
    norm: bool,
    /// Patches of a view, rows and columns, by which the heads are rotated.
    grid: Option<(usize, usize)>,
    global: bool,
    /// Rows of a sequence that lie side by side, in panels; 0 for whole rows one after the other.
    panel: usize,
    /// Channels of a head behind the last, which are zeros.
    padding: usize,
}

const PLAIN: Call = Call {
    heads: 3,
    dim: 16,
    rows: 14,
    first_row: 0,
    out_rows: 14,
    sequence: 7,
    norm: false,
    grid: None,
    global: false,
    panel: 0,
    padding: 0,
};

const COLUMN: usize = 5;
const SCALE: f32 = 0.25;
const EPS: f32 = 1e-5;

impl Call {
    /// In every type.
    fn check(self) {
        elements().into_iter().for_each(|element| self.check_element(element));
    }

    /// Runs the kernel and holds what it wrote, and nothing else, to the reference.
    fn check_element(self, element: Element) {
        let Call { heads, dim, rows, sequence, .. } = self;
        let stride = heads * dim + 2 * COLUMN;
        let projection = stored(element, random(1, rows * stride));
        let (weight, bias) = (random(2, dim), random(3, dim));
        let (grid_rows, grid_columns) = self.grid.unwrap_or((1, 1));
        let table = &rotary_tables(grid_rows, grid_columns, dim)[usize::from(self.global)];

        let mut case = Case::new();
        let transpose = self.panel > 0;
        let padded = sequence.next_multiple_of(self.panel.max(1));
        let out_len = self.out_rows / sequence * padded;
        let channels = dim + self.padding;
        let out = case.output_of(element, heads * channels * out_len);
        let kernel = SplitHeads {
            projection: case.input_of(element, &projection),
            weight: case.input(&weight),
            bias: case.input(&bias),
            rotary: case.input(table),
            out,
            rows: rows as u32,
            heads: heads as u32,
            dim: dim as u32,
            out_dim: channels as u32,
            stride: stride as u32,
            column: COLUMN as u32,
            first_row: self.first_row as u32,
            out_rows: self.out_rows as u32,
            sequence: sequence as u32,
            panel: self.panel as u32,
            tokens: (1 + grid_rows * grid_columns) as u32,
            turned: (table.len() / dim) as u32,
            scale: SCALE,
            eps: EPS,
            norm: self.norm,
            rotate: self.grid.is_some(),
            transpose,
            element,
        };
        case.rec.dispatch_groups(kernel, rows * heads);
        let mut got: Vec<f32> = case.result_of(element, out);

        let truth = self.truth(&projection, stride, &weight, &bias);
        let written: Vec<f32> = (0..rows * heads * dim)
            .map(|i| std::mem::replace(&mut got[self.place(i / dim / heads, i / dim % heads, i % dim)], f32::NAN))
            .collect();
        for row in 0..rows * heads * self.padding {
            let (channel, row) = (dim + row % self.padding, row / self.padding);
            let zero = std::mem::replace(&mut got[self.place(row / heads, row % heads, channel)], f32::NAN);
            assert_eq!(zero, 0.0, "{self:?}: padding");
        }
        assert!(got.iter().all(|x| x.is_nan()), "{self:?}: something else was written");
        let tolerance = if self.norm { Tolerance::sum_of(dim) } else { Tolerance::sum_of(0) };
        assert_close(&format!("{self:?}"), &written, &truth, tolerance.and(Tolerance::ELEMENTWISE).stored_in(element));
    }

    /// Where channel `channel` of a head of this call's row `row` goes.
    fn place(&self, row: usize, head: usize, channel: usize) -> usize {
        let row = self.first_row + row;
        let (sequences, within, panel) = (self.out_rows / self.sequence, row % self.sequence, self.panel);
        if panel > 0 {
            let first = (head * sequences + row / self.sequence) * self.sequence.div_ceil(panel);
            ((first + within / panel) * self.dim + channel) * panel + within % panel
        } else {
            (head * self.out_rows + row) * (self.dim + self.padding) + channel
        }
    }

    /// `[rows, heads, dim]`
    fn truth(&self, projection: &[f32], stride: usize, weight: &[f32], bias: &[f32]) -> Vec<f64> {
        let positions: Option<Vec<_>> = self.grid.map(|(rows, columns)| {
            let view = if self.global { seen_from_patches(rows, columns) } else { local_positions(rows, columns) };
            let from = (0..self.rows).map(|row| view[(self.first_row + row) % view.len()]);
            from.collect()
        });
        let part = Part {
            column: COLUMN,
            heads: self.heads,
            head_dim: self.dim,
            norm: self.norm.then_some((weight, bias, f64::from(EPS))),
            positions: positions.as_deref(),
        };
        split_heads(&widen(projection), stride, part).iter().map(|x| x * f64::from(SCALE)).collect()
    }
}

/// Places of a view's tokens in global blocks, moved together so that patches stand at the origin: only differences count.
fn seen_from_patches(rows: usize, columns: usize) -> Vec<[f64; 2]> {
    global_positions(rows, columns).into_iter().map(|place| place.map(|step| step - 1.0)).collect()
}

#[test]
fn every_switch() {
    for norm in [false, true] {
        for grid in [None, Some((2, 3))] {
            for panel in [0, 8] {
                Call { norm, grid, panel, ..PLAIN }.check();
            }
        }
    }
    Call { grid: Some((2, 3)), global: true, ..PLAIN }.check();
}

#[test]
fn every_head_size() {
    for dim in [4, 8, 12, 16, 24, 32, 48, 64, 96, 128] {
        Call { dim, norm: true, grid: Some((3, 2)), ..PLAIN }.check();
    }
}

#[test]
fn heads_padded_to_whole_matrices() {
    for (dim, padding) in [(4, 4), (24, 8), (16, 0)] {
        Call { dim, padding, norm: true, grid: Some((2, 3)), ..PLAIN }.check();
    }
}

#[test]
fn parts_of_the_rows() {
    for panel in [0, 4] {
        for (first_row, rows) in [(0, 0), (0, 1), (1, 1), (5, 9), (7, 7), (13, 1)] {
            Call { first_row, rows, panel, norm: true, grid: Some((2, 3)), ..PLAIN }.check();
        }
    }
}

#[test]
fn sequences_of_every_remainder() {
    for sequence in 1..=9 {
        let rows = 3 * sequence;
        for panel in [4, 12] {
            Call { rows, out_rows: rows, sequence, panel, ..PLAIN }.check();
        }
    }
}

#[test]
fn rows_beyond_the_most_workgroups() {
    let rows = 65_537;
    Call { heads: 1, dim: 4, rows, out_rows: rows, sequence: rows, grid: Some((4, 4)), ..PLAIN }.check();
}
