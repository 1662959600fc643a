use crate::case::*;
use zipsplat::{kernels::ops::SplitHeads, stages::backbone::rotary_tables};
use zipsplat_tests::reference::backbone::rope::{global_positions, local_positions};
use zipsplat_tests::reference::ops::split_heads::{Part, Pool, split_heads};

#[derive(Clone, Copy, Debug)]
struct Call {
    heads: usize,
    dim: usize,
    rows: usize,
    first_row: usize,
    out_rows: usize,
    sequence: usize,
    norm: bool,
    /// Rows and columns of patches, for the rotation.
    grid: Option<(usize, usize)>,
    global: bool,
    /// Rows interleaved in a panel; 0 for contiguous rows.
    panel: usize,
    /// Zero channels behind a head.
    padding: usize,
    /// Side of the averaged groups of `grid` patches; `first_row` and `rows` then count groups.
    side: usize,
}

const SUBGROUPS: usize = 3;
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
    side: 1,
};

const COLUMN: usize = 5;
const SCALE: f32 = 0.25;
const EPS: f32 = 1e-5;

impl Call {
    fn check(self) {
        elements().into_iter().for_each(|element| self.check_element(element));
    }

    fn check_element(self, element: Element) {
        let Call { heads, dim, rows, sequence, .. } = self;
        let stride = heads * dim + 2 * COLUMN;
        let (grid_rows, grid_columns) = self.grid.unwrap_or((1, 1));
        let projection = stored(element, random(1, self.sources() * stride));
        let (weight, bias) = (random(2, dim), random(3, dim));
        let table = &rotary_tables(grid_rows, grid_columns, dim)[usize::from(self.global)];

        let mut case = plan();
        let transpose = self.panel > 0;
        let padded = sequence.next_multiple_of(self.panel.max(1));
        let out_len = self.out_rows / sequence * padded;
        let channels = dim + self.padding;
        let out = case.output_of(element, heads * channels * out_len);
        let log_counts = case.output::<f32>(self.out_rows);
        let kernel = SplitHeads {
            projection: case.input_of(element, &projection),
            weight: case.input(&weight),
            bias: case.input(&bias),
            rotary: case.input(table),
            out,
            log_counts,
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
            columns: grid_columns as u32,
            leading: 1,
            views: 1,
            own: false,
            first: false,
            pool: self.side as u32,
            count: self.side > 1,
            scale: SCALE,
            eps: EPS,
            norm: self.norm,
            rotate: self.grid.is_some(),
            transpose,
            subgroups: SUBGROUPS as u32,
            element,
        };
        case.rec.dispatch_groups(kernel, (rows * heads).div_ceil(SUBGROUPS));
        let run = case.run().unwrap();
        let mut got = element.decode(&run.read::<u8>(out).unwrap());
        let found_counts: Vec<f32> = run.read(log_counts).unwrap();

        let (truth, counts) = self.truth(&projection, stride, &weight, &bias);
        let counted = self.first_row..self.first_row + counts.len();
        assert!(found_counts.iter().enumerate().all(|(i, x)| counted.contains(&i) || x.is_nan()), "{self:?}: counts");
        assert_close(&format!("{self:?}: counts"), &found_counts[counted], &counts, Tolerance::ELEMENTWISE);
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

    fn pool(&self) -> Option<Pool> {
        let (rows, columns) = self.grid.filter(|_| self.side > 1)?;
        Some(Pool { side: self.side, grid: [rows, columns], leading: 1, own: false, first: false })
    }

    fn sources(&self) -> usize {
        let Some(Pool { side, grid, leading, .. }) = self.pool() else { return self.rows };
        let groups = leading + grid.iter().map(|patches| patches.div_ceil(side)).product::<usize>();
        self.rows / groups * (leading + grid.iter().product::<usize>())
    }

    /// `[rows, heads, dim]` and, for averaged groups, the logarithms of their sizes.
    fn truth(&self, projection: &[f32], stride: usize, weight: &[f32], bias: &[f32]) -> (Vec<f64>, Vec<f64>) {
        let positions: Option<Vec<_>> = self.grid.map(|(rows, columns)| {
            let view = if self.global { seen_from_patches(rows, columns) } else { local_positions(rows, columns) };
            let first = if self.side > 1 { 0 } else { self.first_row };
            let from = (0..self.sources()).map(|row| view[(first + row) % view.len()]);
            from.collect()
        });
        let part = Part {
            column: COLUMN,
            heads: self.heads,
            head_dim: self.dim,
            norm: self.norm.then_some((weight, bias, f64::from(EPS))),
            positions: positions.as_deref(),
        };
        let heads: Vec<f64> =
            split_heads(&widen(projection), stride, part).iter().map(|x| x * f64::from(SCALE)).collect();
        let Some(pool) = self.pool() else { return (heads, Vec::new()) };
        let (means, counts) = pool.means(&heads, self.heads * self.dim);
        (means, counts.into_iter().map(f64::ln).collect())
    }
}

/// Shifted so that patches start at 0: only differences matter.
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

/// Two views of 3 x 5 patches, then the second alone.
#[test]
fn means_of_groups_of_patches() {
    for (side, groups) in [(2, 7), (3, 3), (4, 3)] {
        for (global, panel, padding) in [(false, 0, 0), (true, 4, 0), (true, 0, 16)] {
            let grid = Some((3, 5));
            let both = Call { rows: 2 * groups, out_rows: 2 * groups, sequence: 2 * groups, ..PLAIN };
            let both = Call { side, grid, global, panel, padding, norm: true, ..both };
            both.check();
            Call { first_row: groups, rows: groups, ..both }.check();
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
