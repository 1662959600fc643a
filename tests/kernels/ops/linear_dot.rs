//! Linear layers of 8-bit integers by dot products, against integer sums and bitwise against matrix
//! units.

use crate::case::{Case, random, stored};
use zipsplat::{
    gpu::{Element, Limits},
    ops::{
        Activation, Epilogue, LaneTile, Linear, LinearKernel, Rows, Tiles, Units, Weights, pack_matrix, quantise_rows,
    },
};
use zipsplat_tests::{
    compare::{Tolerance, assert_close, assert_same},
    device::device,
    reference::ops::linear_dot::linear_dot,
};

const BY_RULE: LinearKernel = LinearKernel::Dots(Tiles::BY_RULE);

/// A random layer and its rows.
struct Layer {
    rows: usize,
    inner: usize,
    columns: usize,
    x: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Layer {
    fn random([rows, inner, columns]: [usize; 3]) -> Self {
        let (x, weight) = (stored(Element::F16, random(1, rows * inner)), random(2, columns * inner));
        Self { rows, inner, columns, x, weight, bias: random(3, columns) }
    }

    fn input(&self, case: &mut Case) -> Rows {
        let tensor = case.input_of(Element::F16, &self.x);
        Rows { tensor, count: self.rows, width: self.inner, element: Element::F16 }
    }

    /// Returns a kernel's results; GELU comes with a residual and a scale.
    fn results(&self, limits: &Limits, kernel: LinearKernel, activation: Activation, output: Element) -> Vec<f32> {
        let mut case = Case::within(limits);
        let input = self.input(&mut case);
        let packed = pack_matrix(kernel, &self.weight, self.inner, self.columns);
        let (weight, bias) = (case.input(&packed), case.input(&self.bias));
        let layer = Linear { weight, bias, inner: self.inner, columns: self.columns, kernel };
        let width = layer.out_columns(activation);
        let residual = (activation == Activation::Gelu).then(|| case.input(&random(4, self.rows * width)));
        let residual = residual.map(|tensor| Rows::new(tensor, self.rows, width));
        let epilogue = Epilogue { activation, gamma: residual.map(|_| bias), residual };
        let out = case.output_of(output, self.rows * width);
        let out_rows = Rows { tensor: out, count: self.rows, width, element: output };
        layer.record(&mut case.rec, input, out_rows, epilogue);
        case.result_of(output, out)
    }

    /// Returns the device's quantized rows and their scales.
    fn integers(&self) -> (Vec<i8>, Vec<f32>) {
        let mut case = Case::new();
        let input = self.input(&mut case);
        let (out, scales) = quantise_rows(&mut case.rec, input);
        case.rec.output(out.tensor);
        case.rec.output(scales);
        let run = case.run();
        (run.read(out.tensor).unwrap(), run.read(scales).unwrap())
    }
}

fn bits(values: Vec<f32>) -> Vec<u32> {
    values.into_iter().map(f32::to_bits).collect()
}

fn has_dot_products() -> bool {
    device().limits().dot_products
}

/// Around its tiles: one row, one quad, partial tiles of 8 terms, long sums.
const SHAPES: [[usize; 3]; 7] =
    [[1, 8, 8], [7, 24, 32], [9, 72, 40], [33, 64, 136], [70, 96, 264], [3, 4096, 24], [130, 40, 72]];

#[test]
fn equals_sums_of_whole_numbers() {
    for shape in SHAPES.into_iter().filter(|_| has_dot_products()) {
        let layer = Layer::random(shape);
        let packed = pack_matrix(BY_RULE, &layer.weight, layer.inner, layer.columns);
        let (weight, scales) = packed.split_at(packed.len() - 4 * layer.columns);
        let weight: Vec<i8> = weight[..layer.columns * layer.inner].iter().map(|byte| *byte as i8).collect();
        let scales: Vec<f32> = scales.as_chunks().0.iter().map(|bytes| f32::from_ne_bytes(*bytes)).collect();
        let (x, row_scales) = layer.integers();
        let truth = linear_dot((&x, &row_scales), (&weight, &scales), &layer.bias);
        let found = layer.results(device().limits(), BY_RULE, Activation::None, Element::F32);
        assert_close(&format!("{shape:?}"), &found, &truth, Tolerance::ELEMENTWISE);
    }
}

#[test]
fn gives_the_bits_of_matrix_units() {
    let units = Units::of(Element::I8, device().limits()).filter(|_| has_dot_products());
    for (units, shape) in units.into_iter().flat_map(|units| SHAPES.map(|shape| (units, shape))) {
        let layer = Layer::random(shape);
        for activation in [Activation::None, Activation::Gelu, Activation::SwiGlu] {
            for output in [Element::F32, Element::F16] {
                let kernels = [LinearKernel::Matrix(units, Weights::Factors), BY_RULE];
                let [matrix, dots] =
                    kernels.map(|kernel| bits(layer.results(device().limits(), kernel, activation, output)));
                assert_same(&format!("{shape:?} {activation:?} {output:?}"), &dots, &matrix);
            }
        }
    }
}

#[test]
fn every_tile_gives_the_same_bits() {
    for limits in [false, true].map(|cpu| Limits { cpu, ..device().limits().clone() }) {
        let tiles = if has_dot_products() { LaneTile::candidates(&limits, Element::I8) } else { Vec::new() };
        for shape in [[270, 72, 264], [5, 8, 8]] {
            let layer = Layer::random(shape);
            let of = |limits: &Limits, kernel| bits(layer.results(limits, kernel, Activation::Gelu, Element::F32));
            for (index, tile) in tiles.iter().enumerate() {
                let found = of(&limits, LinearKernel::Dots(Tiles::always(index)));
                assert_same(&format!("{tile} {shape:?}"), &found, &of(device().limits(), BY_RULE));
            }
        }
    }
}

#[test]
fn nan_stays_in_its_row() {
    if !has_dot_products() {
        return;
    }
    let mut layer = Layer::random([9, 40, 24]);
    let clean = layer.results(device().limits(), BY_RULE, Activation::None, Element::F32);
    layer.x[4 * 40 + 17] = f32::NAN;
    let found = layer.results(device().limits(), BY_RULE, Activation::None, Element::F32);
    for (row, (found, clean)) in found.chunks(24).zip(clean.chunks(24)).enumerate() {
        match row {
            4 => assert!(found.iter().all(|x| x.is_nan()), "{found:?}"),
            _ => assert_same(&format!("row {row}"), &bits(found.to_vec()), &bits(clean.to_vec())),
        }
    }
}
