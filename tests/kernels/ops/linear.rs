//! Linear layers and all their epilogues against the plain product in f64.

use crate::case::{Case, random};
use zipsplat::{
    gpu::Limits,
    kernels::limits::{LINEAR_ROWS, PANEL_COLUMNS},
    ops::{Activation, Epilogue, Linear},
};
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::device::device;
use zipsplat_tests::reference::{
    ops::{
        activation::{gelu, swiglu},
        add::add,
        linear::{layer_scale, linear},
    },
    widen,
};

/// A layer as a checkpoint has it: `weight [columns, inner]`, for SwiGLU [gate | value].
struct Layer {
    inner: usize,
    columns: usize,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Layer {
    fn random(inner: usize, columns: usize) -> Layer {
        Layer { inner, columns, weight: random(1, columns * inner), bias: random(2, columns) }
    }

    /// As the engine packs it; columns beyond the last hold NaN, which must reach nothing.
    fn input(&self, case: &mut Case, activation: Activation) -> Linear {
        let row_from_column = |c: usize| match activation {
            Activation::SwiGlu => c % 2 * (self.columns / 2) + c / 2,
            _ => c,
        };
        let panel = PANEL_COLUMNS as usize;
        let mut weight = vec![f32::NAN; self.inner * self.columns.next_multiple_of(panel)];
        for (i, value) in weight.iter_mut().enumerate() {
            let (column, k) = (i / panel / self.inner * panel + i % panel, i / panel % self.inner);
            if column < self.columns {
                *value = self.weight[row_from_column(column) * self.inner + k];
            }
        }
        let bias: Vec<f32> = (0..self.columns).map(|c| self.bias[row_from_column(c)]).collect();
        Linear { weight: case.input(&weight), bias: case.input(&bias), inner: self.inner, columns: self.columns }
    }

    fn truth(&self, x: &[f32], activation: Activation, gamma: Option<&[f32]>, residual: Option<&[f32]>) -> Vec<f64> {
        let sums = linear(&widen(x), &self.weight, &self.bias);
        let activated = match activation {
            Activation::None => sums,
            Activation::Gelu => sums.into_iter().map(gelu).collect(),
            Activation::SwiGlu => swiglu(&sums, self.columns / 2),
        };
        let scaled = gamma.map_or(activated.clone(), |gamma| layer_scale(&activated, gamma));
        residual.map_or(scaled.clone(), |residual| add(&scaled, &widen(residual)))
    }

    /// Sums of `inner` products. An activation's slope is at most 1.13, SwiGLU multiplies two such sums.
    fn tolerance(&self, activation: Activation) -> Tolerance {
        let sums = Tolerance::sum_of(self.inner).and(Tolerance::ELEMENTWISE);
        if activation == Activation::SwiGlu { sums.times(2.0) } else { sums }
    }
}

fn check(limits: &Limits, rows: usize, layer: &Layer, activation: Activation, scaled: bool, added: bool) {
    let mut case = Case::within(limits);
    let device_layer = layer.input(&mut case, activation);
    let out_columns = device_layer.out_columns(activation);
    let x = random(3, rows * layer.inner);
    let gamma = scaled.then(|| random(4, out_columns));
    let residual = added.then(|| random(5, rows * out_columns));
    let (input, out) = (case.input(&x), case.output::<f32>(rows * out_columns));
    let epilogue = Epilogue {
        activation,
        gamma: gamma.as_ref().map(|g| case.input(g)),
        residual: residual.as_ref().map(|r| case.input(r)),
    };
    device_layer.record(&mut case.rec, input, rows, out, epilogue);
    let name = format!("{rows} x {} -> {} {activation:?} {scaled} {added}", layer.inner, layer.columns);
    let truth = layer.truth(&x, activation, gamma.as_deref(), residual.as_deref());
    assert_close(&name, &case.result::<f32>(out), &truth, layer.tolerance(activation));
}

fn check_plain(rows: usize, inner: usize, columns: usize) {
    check(device().limits(), rows, &Layer::random(inner, columns), Activation::None, false, false);
}

#[test]
fn equals_the_reference_around_its_tiles() {
    for rows in [0, 1, 7, 8, 9, 15, 16, 17, 31, 33, 65] {
        for columns in [1, 2, 3, 4, 5, 31, 32, 33, 63, 65, 127, 128, 129, 258] {
            check_plain(rows, 12, columns);
        }
    }
}

#[test]
fn equals_the_reference_for_short_and_long_sums() {
    for inner in [4, 8, 60, 64, 68, 128, 588, 1536, 4096, 6144] {
        check_plain(19, inner, 70);
    }
}

#[test]
fn every_epilogue() {
    for columns in [4, 36, 132] {
        let layer = Layer::random(24, columns);
        for activation in [Activation::None, Activation::Gelu] {
            for (scaled, added) in [(false, false), (true, false), (false, true), (true, true)] {
                check(device().limits(), 21, &layer, activation, scaled, added);
            }
        }
        check(device().limits(), 21, &layer, Activation::SwiGlu, false, false);
    }
}

#[test]
fn the_activation_holds_far_from_zero() {
    // Sums up to +-60: GELU and SiLU are 0 or the identity there, and exp overflows on the way.
    let mut layer = Layer::random(16, 64);
    layer.weight.iter_mut().for_each(|w| *w *= 15.0);
    for activation in [Activation::Gelu, Activation::SwiGlu] {
        check(device().limits(), 40, &layer, activation, false, false);
    }
}

#[test]
fn adds_to_its_own_output() {
    let (layer, rows) = (Layer::random(40, 50), 37);
    let (x, stream, gamma) = (random(6, rows * 40), random(7, rows * 50), random(8, 50));
    let mut case = Case::new();
    let (input, residual) = (case.input(&x), case.input(&stream));
    let epilogue = Epilogue { gamma: Some(case.input(&gamma)), residual: Some(residual), ..Epilogue::default() };
    layer.input(&mut case, Activation::None).record(&mut case.rec, input, rows, residual, epilogue);
    case.rec.output(residual);
    let truth = layer.truth(&x, Activation::None, Some(&gamma), Some(&stream));
    assert_close("in place", &case.result::<f32>(residual), &truth, layer.tolerance(Activation::None));
}

#[test]
fn rows_that_are_bound_in_parts() {
    let limits = Limits { max_binding_bytes: 64 << 10, ..device().limits().clone() };
    for activation in [Activation::None, Activation::SwiGlu] {
        check(&limits, 1000, &Layer::random(64, 96), activation, false, false);
    }
    check(&limits, 1000, &Layer::random(64, 96), Activation::Gelu, true, true);
}

#[test]
fn rows_beyond_the_most_workgroups() {
    check_plain(LINEAR_ROWS as usize * 65_536 + 1, 4, 4);
}
