/// Sets the fields common to linear kernels, with those of `weights` in any format.
macro_rules! linear_kernel {
    ($kernel:ident, $linear:ident, $input:ident, $out:ident, $epilogue:ident, { $($own:tt)* }) => {
        ops::$kernel {
            a: $input.tensor,
            bias: $linear.bias,
            gamma: $epilogue.gamma.unwrap_or($linear.bias),
            residual: $epilogue.residual.map_or($linear.bias, |residual| residual.tensor),
            out: $out.tensor,
            rows: $input.count as u32,
            inner: $linear.inner as u32,
            columns: $linear.columns as u32,
            activation: $epilogue.activation as u32,
            scale: $epilogue.gamma.is_some(),
            add: $epilogue.residual.is_some(),
            $($own)*
        }
    };
    (weights $kernel:ident, $linear:ident, $input:ident, $out:ident, $epilogue:ident, { $($own:tt)* }) => {{
        let [weight, integers, scales] = $linear.weights();
        linear_kernel!($kernel, $linear, $input, $out, $epilogue, {
            weight,
            integers,
            scales,
            q8: $linear.kernel.weights() == $crate::ops::Weights::Q8,
            $($own)*
        })
    }};
}

mod dots;
mod lanes;

pub use lanes::{LaneTile, Lanes};

use super::{
    Units,
    rows::{Rows, SCRATCH_BYTES, SLICE, quantize_rows, row_chunks},
    tile::{Tile, Tiles, choose, split_k},
    uniform::UNIFORM_TILE,
};
use crate::{
    gpu::{Element, Limits, Recorder, Tensor},
    kernels::{
        limits::{PANEL_COLUMNS, Q8_GROUP},
        ops,
    },
};
use half::f16;

/// Minimum row bytes in chunking: limits workgroups per axis to 65,535.
pub(crate) const NARROWEST: usize =
    (SCRATCH_BYTES as usize / (UNIFORM_TILE[0] as usize * 65_535) + 1).next_multiple_of(SLICE);

#[derive(Clone, Copy, Debug)]
pub struct Linear {
    /// Packed weight, see [`pack_matrix`](super::pack_matrix).
    pub weight: Tensor,
    /// `[columns]` f32.
    pub bias: Tensor,
    /// Padded values per input row.
    pub inner: usize,
    /// Outputs, before SwiGLU.
    pub columns: usize,
    pub kernel: LinearKernel,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinearKernel {
    /// ops/linear, ops/linear_uniform or ops/linear_tiled. The weight is `[panels, inner,
    /// PANEL_COLUMNS]`.
    Panels(Lanes, Weights),
    /// ops/linear_matrix, with the weight `[columns, inner]`. For 8-bit factors, `[columns]` f32
    /// scales follow and f16 inputs are quantized per row.
    Matrix(Units, Weights),
    /// ops/linear_dot, in the 8-bit layout of matrix units.
    Dots(Tiles),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weights {
    /// In the factor type.
    Factors,
    /// [`Q8`](super::Q8): integers, then f16 scales at a 256-byte boundary.
    Q8,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activation {
    /// Identity.
    #[default]
    None,
    /// The exact (erf) GELU.
    Gelu,
    /// silu(gate) * value over alternating columns, a multiple of 4. Excludes gamma and residual.
    SwiGlu,
}

/// out = residual + gamma * activation(linear(x)).
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue {
    pub activation: Activation,
    /// LayerScale, `[columns]` f32.
    pub gamma: Option<Tensor>,
    /// f32 residual; may alias the output.
    pub residual: Option<Rows>,
}

impl LinearKernel {
    pub fn element(self) -> Element {
        match self.factor() {
            Element::I8 => Element::F16,
            element => element,
        }
    }

    pub fn factor(self) -> Element {
        match self {
            LinearKernel::Panels(Lanes { element, .. }, _) | LinearKernel::Matrix(Units { factor: element, .. }, _) => {
                element
            }
            LinearKernel::Dots(_) => Element::I8,
        }
    }

    pub fn weights(self) -> Weights {
        match self {
            LinearKernel::Panels(_, weights) | LinearKernel::Matrix(_, weights) => weights,
            LinearKernel::Dots(_) => Weights::Factors,
        }
    }

    pub fn with_q8(self) -> Option<Self> {
        match self {
            LinearKernel::Matrix(Units { factor: Element::I8, .. }, _) | LinearKernel::Dots(_) => None,
            LinearKernel::Matrix(units, _) => Some(LinearKernel::Matrix(units, Weights::Q8)),
            LinearKernel::Panels(lanes, _) => Some(LinearKernel::Panels(lanes, Weights::Q8)),
        }
    }

    pub(super) fn padded_columns(self, columns: usize) -> usize {
        match self {
            LinearKernel::Panels(..) => columns.next_multiple_of(PANEL_COLUMNS as usize),
            LinearKernel::Matrix(..) | LinearKernel::Dots(_) => columns,
        }
    }

    /// Alignment of input rows in values.
    pub fn vector(self) -> usize {
        16 / self.element().bytes()
    }
}

pub(super) fn scales_at(columns: usize, inner: usize) -> usize {
    (columns * inner).next_multiple_of(SLICE)
}

impl Linear {
    pub fn element(&self) -> Element {
        self.kernel.element()
    }

    pub fn out_columns(&self, activation: Activation) -> usize {
        if activation == Activation::SwiGlu { self.columns / 2 } else { self.columns }
    }

    pub fn apply(&self, rec: &mut Recorder, name: &str, input: Rows, output: Element, epilogue: Epilogue) -> Rows {
        let out = Rows::scratch(rec, name, input.count, self.out_columns(epilogue.activation), output);
        self.record(rec, input, out, epilogue);
        out
    }

    pub fn record(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue) {
        let alone = epilogue.gamma.is_none() && epilogue.residual.is_none() && self.columns.is_multiple_of(4);
        assert!(alone || epilogue.activation != Activation::SwiGlu, "SwiGLU comes alone and in whole vec4");
        let added = epilogue.residual.map_or(0, |residual| residual.row_bytes());
        for part in row_chunks(rec, input.count, &[input.row_bytes(), out.row_bytes(), added, NARROWEST]) {
            let (input, out) = (input.part(part.clone()), out.part(part.clone()));
            let residual = epilogue.residual.map(|residual| residual.part(part));
            let epilogue = Epilogue { residual, ..epilogue };
            let split_k = split_k(self.kernel.factor(), self.inner, input.count, self.columns);
            let parts = self.inner.div_ceil(split_k);
            if parts == 1 {
                self.sums(rec, input, out, epilogue, split_k);
            } else {
                let sums = Rows::scratch(rec, "sums", parts * input.count, self.columns, Element::F32);
                self.sums(rec, input, sums, Epilogue::default(), split_k);
                self.merge(rec, sums, parts, out, epilogue);
            }
        }
    }

    fn sums(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue, split_k: usize) {
        match self.kernel {
            LinearKernel::Panels(lanes, _) => self.on_lanes(rec, lanes, input, out, epilogue, split_k),
            LinearKernel::Matrix(units, _) => self.matrix(rec, units, input, out, epilogue, split_k),
            LinearKernel::Dots(tiles) => self.dots(rec, tiles, input, out, epilogue),
        }
    }

    fn merge(&self, rec: &mut Recorder, sums: Rows, parts: usize, out: Rows, epilogue: Epilogue) {
        let kernel = ops::LinearMerge {
            sums: sums.tensor,
            bias: self.bias,
            gamma: epilogue.gamma.unwrap_or(self.bias),
            residual: epilogue.residual.map_or(self.bias, |residual| residual.tensor),
            out: out.tensor,
            rows: out.count as u32,
            columns: self.columns as u32,
            parts: parts as u32,
            activation: epilogue.activation as u32,
            scale: epilogue.gamma.is_some(),
            add: epilogue.residual.is_some(),
            output: out.element,
        };
        rec.dispatch(kernel, out.count * self.columns.div_ceil(4));
    }

    /// Three bindings, with `bias` as the placeholder.
    fn weights(&self) -> [Tensor; 3] {
        let values = self.kernel.padded_columns(self.columns) * self.inner;
        match self.kernel.weights() {
            Weights::Factors => [self.weight.slice_of(self.kernel.factor(), 0, values), self.bias, self.bias],
            Weights::Q8 => {
                let at = scales_at(self.kernel.padded_columns(self.columns), self.inner);
                [
                    self.bias,
                    self.weight.slice::<i8>(0, values),
                    self.weight.slice::<f16>(at / 2, values / Q8_GROUP as usize),
                ]
            }
        }
    }

    /// Quantized input, per-row input scales, per-column weight scales.
    fn quantized(&self, rec: &mut Recorder, input: Rows) -> (Rows, Tensor, Tensor) {
        let (a, scales) = quantize_rows(rec, input);
        (a, scales, self.weight.slice::<f32>(scales_at(self.columns, self.inner) / 4, self.columns))
    }

    fn matrix(&self, rec: &mut Recorder, units: Units, input: Rows, out: Rows, epilogue: Epilogue, split_k: usize) {
        let Units { factor, shape, .. } = units;
        let (columns, inner, rows) = (self.columns, self.inner, input.count);
        let tile = self.tile(rec.limits(), units, rows);
        assert!(
            split_k == inner || split_k.is_multiple_of(tile.k as usize),
            "parts of {split_k} terms, {} at a time",
            tile.k
        );
        let (a, row_scales, column_scales) = match factor {
            Element::I8 => self.quantized(rec, input),
            _ => (input, self.bias, self.bias),
        };
        let kernel = linear_kernel!(weights LinearMatrix, self, a, out, epilogue, {
            row_scales,
            column_scales,
            subgroups: tile.all_subgroups(),
            subgroups_n: tile.subgroups[1],
            matrix_m: shape.m,
            matrix_n: shape.n,
            matrix_k: shape.k,
            repeat_m: tile.repeats[0],
            repeat_n: tile.repeats[1],
            tile_k: tile.k,
            share: split_k as u32,
            split: split_k < inner,
            whole: inner.is_multiple_of(tile.k as usize),
            factor,
            output: out.element,
        });
        let [tile_rows, tile_columns] = tile.sides(units);
        // Columns vary fastest: workgroups share rows in cache.
        let groups = [columns.div_ceil(tile_columns), rows.div_ceil(tile_rows), inner.div_ceil(split_k)];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn tile(&self, limits: &Limits, units: Units, rows: usize) -> Tile {
        let candidates = Tile::linear(limits, units);
        let workgroups = |tile: &Tile| {
            let [tile_rows, tile_columns] = tile.sides(units);
            rows.div_ceil(tile_rows) * self.columns.div_ceil(tile_columns)
        };
        choose(&candidates, units.tiles.of(rows * self.columns), if limits.cpu { 1 } else { 3 }, workgroups)
    }

    fn flops(&self, rows: usize) -> u64 {
        (2 * rows * self.inner * self.columns) as u64
    }
}
