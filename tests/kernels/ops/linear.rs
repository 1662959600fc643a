//! Linear layers and all epilogues against the f64 product.

use crate::case::{Case, elements, linear_kernels, q8_kernels, random, stored, with_and_without_addresses};
use zipsplat::{
    gpu::{Element, Limits},
    kernels::limits::{LINEAR_ROWS, PANEL_COLUMNS},
    ops::{
        Activation, Epilogue, LaneTile, Lanes, Linear, LinearKernel, Q8, Rows, Tile, Tiles, Units, Weights, pack_matrix,
    },
};
use zipsplat_tests::compare::{Tolerance, assert_close, assert_same};
use zipsplat_tests::device::device;
use zipsplat_tests::reference::{
    ops::{
        activation::{gelu, swiglu},
        add::add,
        linear::{layer_scale, linear},
    },
    widen,
};

/// A layer as in a checkpoint: `weight [columns, inner]`, for SwiGLU [gate | value].
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

    /// Uploads the layer for a kernel; padding columns hold NaN, which must not spread.
    fn input(&self, case: &mut Case, kernel: LinearKernel, activation: Activation) -> Linear {
        let row_from_column = |c: usize| match activation {
            Activation::SwiGlu => c % 2 * (self.columns / 2) + c / 2,
            _ => c,
        };
        let panel = PANEL_COLUMNS as usize;
        let inner = self.inner.next_multiple_of(kernel.vector());
        let value = |column: usize, k: usize| match (column < self.columns, k < self.inner) {
            (true, true) => self.weight[row_from_column(column) * self.inner + k],
            (true, false) => 0.0,
            (false, _) => f32::NAN,
        };
        let bias: Vec<f32> = (0..self.columns).map(|c| self.bias[row_from_column(c)]).collect();
        let rows = || (0..inner * self.columns).map(|i| value(i / inner, i % inner)).collect::<Vec<f32>>();
        let weight = match kernel {
            _ if kernel.weights() == Weights::Q8 || kernel.factor() == Element::I8 => {
                case.input(&pack_matrix(kernel, &rows(), inner, self.columns))
            }
            LinearKernel::Panels(Lanes { element, .. }, _) => {
                let at = |i| value(i / panel / inner * panel + i % panel, i / panel % inner);
                let weight: Vec<f32> = (0..inner * self.columns.next_multiple_of(panel)).map(at).collect();
                case.input_of(element, &weight)
            }
            LinearKernel::Matrix(..) | LinearKernel::Dots(_) => case.input_of(kernel.factor(), &rows()),
        };
        Linear { weight, bias: case.input(&bias), inner, columns: self.columns, kernel }
    }

    /// Uploads rows for a kernel, padded with zeros.
    fn rows(&self, case: &mut Case, kernel: LinearKernel, x: &[f32]) -> Rows {
        let width = self.inner.next_multiple_of(kernel.vector());
        let padding = vec![0.0; width - self.inner];
        let padded: Vec<f32> = x.chunks(self.inner).flat_map(|row| [row, &padding].concat()).collect();
        let element = kernel.element();
        Rows { tensor: case.input_of(element, &padded), count: x.len() / self.inner, width, element }
    }

    /// Computes the truth of factors rounded to `factor`.
    fn truth(&self, factor: Element, x: &[f32], activation: Activation, gamma: Option<&[f32]>) -> Vec<f64> {
        let held =
            |values: &[f32]| if factor == Element::I8 { values.to_vec() } else { stored(factor, values.to_vec()) };
        let sums = linear(&widen(&held(x)), &held(&self.weight), &self.bias);
        let activated = match activation {
            Activation::None => sums,
            Activation::Gelu => sums.into_iter().map(gelu).collect(),
            Activation::SwiGlu => swiglu(&sums, self.columns / 2),
        };
        gamma.map_or(activated.clone(), |gamma| layer_scale(&activated, gamma))
    }

    /// Sums of `inner` products, exact in f32 for f16 factors. An activation's slope is at most
    /// 1.13; SwiGLU multiplies two sums.
    fn tolerance(&self, kernel: LinearKernel, activation: Activation, output: Element) -> Tolerance {
        let sums = Tolerance::sum_of(self.inner).and(Tolerance::ELEMENTWISE);
        let sums = match kernel {
            LinearKernel::Matrix(units, _) if !device().limits().cpu => {
                sums.and(Tolerance::sum_cut_off(self.inner.div_ceil(units.shape.k as usize)))
            }
            _ => sums,
        };
        let sums = if activation == Activation::SwiGlu { sums.times(2.0) } else { sums };
        sums.stored_in(output)
    }

    /// Returns the layer with weights exact in `factor`.
    fn for_factors(&self, factor: Element) -> Layer {
        Layer { weight: holdable(factor, &self.weight, self.inner), bias: self.bias.clone(), ..*self }
    }

    /// Returns the kernels for this layer.
    fn kernels(&self, activation: Activation) -> Vec<LinearKernel> {
        let vector = if activation == Activation::SwiGlu { 8 } else { 4 };
        let whole =
            |kernel: &LinearKernel| self.columns.is_multiple_of(vector) || matches!(kernel, LinearKernel::Panels(..));
        linear_kernels().into_iter().filter(whole).collect()
    }
}

/// Returns rows exact in `factor`. For 8-bit integers the scale is a power of two; their rounding
/// has its own test.
fn holdable(factor: Element, values: &[f32], width: usize) -> Vec<f32> {
    let whole = |(i, x): (usize, &f32)| if i % width == 0 { 127.0 } else { (126.0 * x).round().clamp(-127.0, 127.0) };
    match factor {
        Element::I8 => values.iter().enumerate().map(whole).map(|x| x / 128.0).collect(),
        _ => values.to_vec(),
    }
}

/// Checks every kernel with each of its output types.
fn check(limits: &Limits, rows: usize, layer: &Layer, activation: Activation, scaled: bool, added: bool) {
    for kernel in layer.kernels(activation) {
        for output in elements().into_iter().filter(|output| [Element::F32, kernel.element()].contains(output)) {
            for limits in with_and_without_addresses(limits, has_twin(kernel)) {
                check_kernel(&limits, (kernel, output), rows, layer, activation, scaled, added);
            }
        }
    }
}

/// Returns whether the kernel has a variant that reads by address.
fn has_twin(kernel: LinearKernel) -> bool {
    kernel == LinearKernel::Panels(Lanes::of(Element::F32), Weights::Factors)
}

fn check_kernel(
    limits: &Limits,
    (kernel, output): (LinearKernel, Element),
    rows: usize,
    layer: &Layer,
    activation: Activation,
    scaled: bool,
    added: bool,
) {
    let mut case = Case::within(limits);
    let layer = layer.for_factors(kernel.factor());
    let device_layer = layer.input(&mut case, kernel, activation);
    let out_columns = device_layer.out_columns(activation);
    let x = holdable(kernel.factor(), &random(3, rows * layer.inner), layer.inner);
    let gamma = scaled.then(|| random(4, out_columns));
    let residual = added.then(|| random(5, rows * out_columns));
    let (input, out) = (layer.rows(&mut case, kernel, &x), case.output_of(output, rows * out_columns));
    let epilogue = Epilogue {
        activation,
        gamma: gamma.as_ref().map(|g| case.input(g)),
        residual: residual.as_ref().map(|r| Rows::new(case.input(r), rows, out_columns)),
    };
    let out_rows = Rows { tensor: out, count: rows, width: out_columns, element: output };
    device_layer.record(&mut case.rec, input, out_rows, epilogue);
    let name = format!("{kernel:?} {rows} x {} -> {} {activation:?} {scaled} {added}", layer.inner, layer.columns);
    let product = layer.truth(kernel.factor(), &x, activation, gamma.as_deref());
    let truth = residual.map_or(product.clone(), |residual| add(&product, &widen(&residual)));
    assert_close(&name, &case.result_of(output, out), &truth, layer.tolerance(kernel, activation, output));
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
        check_plain(19, inner, 72);
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
    // Sums up to +-60: GELU and SiLU saturate and exp overflows inside.
    let mut layer = Layer::random(16, 64);
    layer.weight.iter_mut().for_each(|w| *w *= 15.0);
    for activation in [Activation::Gelu, Activation::SwiGlu] {
        check(device().limits(), 40, &layer, activation, false, false);
    }
}

#[test]
fn adds_to_its_own_output() {
    let rows = 37;
    let (stream, gamma) = (random(7, rows * 52), random(8, 52));
    for kernel in linear_kernels() {
        let layer = Layer::random(40, 52).for_factors(kernel.factor());
        let x = holdable(kernel.factor(), &random(6, rows * 40), 40);
        let mut case = Case::new();
        let (input, residual) = (layer.rows(&mut case, kernel, &x), case.input(&stream));
        let target = Rows::new(residual, rows, 52);
        let epilogue = Epilogue { gamma: Some(case.input(&gamma)), residual: Some(target), ..Epilogue::default() };
        let device_layer = layer.input(&mut case, kernel, Activation::None);
        device_layer.record(&mut case.rec, input, target, epilogue);
        case.rec.output(residual);
        let product = layer.truth(kernel.factor(), &x, Activation::None, Some(&gamma));
        let truth = add(&product, &widen(&stream));
        let tolerance = layer.tolerance(kernel, Activation::None, Element::F32);
        assert_close(&format!("{kernel:?} in place"), &case.result::<f32>(residual), &truth, tolerance);
    }
}

#[test]
fn what_f16_cannot_hold_saturates() {
    let layer = Layer { inner: 8, columns: 8, weight: vec![200.0; 64], bias: vec![0.0; 8] };
    let gives_f16 = |kernel: &LinearKernel| kernel.element() != Element::Bf16 && elements().contains(&Element::F16);
    for kernel in linear_kernels().into_iter().filter(gives_f16) {
        for (activation, sign) in [(Activation::None, 1.0), (Activation::None, -1.0), (Activation::SwiGlu, 1.0)] {
            let mut case = Case::new();
            let input = layer.rows(&mut case, kernel, &[100.0 * sign; 8]);
            let device_layer = layer.input(&mut case, kernel, activation);
            let epilogue = Epilogue { activation, ..Epilogue::default() };
            let out = device_layer.apply(&mut case.rec, "out", input, Element::F16, epilogue).tensor;
            case.rec.output(out);
            let values = case.result_of(Element::F16, out);
            assert!(values.iter().all(|x| *x == 65504.0 * sign), "{kernel:?} {activation:?}: {values:?}");
        }
    }
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

/// Returns the bits of a layer's f32 results within these limits.
fn bits(limits: &Limits, kernel: LinearKernel, layer: &Layer, x: &[f32], activation: Activation) -> Vec<u32> {
    let mut case = Case::within(limits);
    let input = layer.rows(&mut case, kernel, x);
    let device_layer = layer.input(&mut case, kernel, activation);
    let epilogue = Epilogue { activation, ..Epilogue::default() };
    let out = device_layer.apply(&mut case.rec, "out", input, Element::F32, epilogue).tensor;
    case.rec.output(out);
    case.result(out)
}

/// Returns weights exact in every factor type: each group starts with 127 times its scale, a power
/// of two.
fn grouped(inner: usize, columns: usize) -> Layer {
    let mut layer = Layer::random(inner, columns);
    for (g, group) in layer.weight.chunks_mut(Q8::GROUP).enumerate() {
        let scale = ((g % 3) as f32 - 8.0).exp2();
        group.iter_mut().enumerate().for_each(|(i, w)| *w = scale * if i == 0 { 127.0 } else { (126.0 * *w).round() });
    }
    layer
}

#[test]
fn q8_weights_equal_the_reference() {
    let shapes = [(1, 32, 1), (17, 64, 36), (33, 96, 130), (19, 1536, 72), (270, 160, 264)];
    for (rows, inner, columns) in shapes {
        let layer = grouped(inner, columns);
        for activation in [Activation::None, Activation::Gelu, Activation::SwiGlu] {
            let able = layer.kernels(activation);
            let gated = activation == Activation::SwiGlu;
            for [kernel, q8] in q8_kernels().into_iter().filter(|[kernel, _]| able.contains(kernel)) {
                if !gated || columns.is_multiple_of(4) {
                    let added = activation == Activation::Gelu;
                    // Products of two sums vary too much for 16 bits.
                    let output = if gated { Element::F32 } else { kernel.element() };
                    check_kernel(device().limits(), (q8, output), rows, &layer, activation, added, added);
                }
            }
        }
    }
}

#[test]
fn q8_weights_give_the_bits_of_what_they_stand_for() {
    let (rows, inner, columns) = (37, 224, 100);
    let x = random(3, rows * inner);
    for [kernel, q8] in q8_kernels() {
        let mut layer = grouped(inner, columns);
        if kernel.factor() == Element::F32 {
            // Weights that need f32, in groups of very different scales.
            let sized = |(i, x): (usize, f32)| x * 10f32.powi((i / Q8::GROUP % 7) as i32 - 4);
            let values: Vec<f32> = random(1, columns * inner).into_iter().enumerate().map(sized).collect();
            Q8::round(&values).expect("small weights").values(&mut layer.weight);
        }
        let [expected, found] =
            [kernel, q8].map(|kernel| bits(device().limits(), kernel, &layer, &x, Activation::None));
        assert_same(&format!("{q8:?}"), &found, &expected);
    }
}

#[test]
fn reading_by_address_changes_no_bit() {
    let kernel = LinearKernel::Panels(Lanes::of(Element::F32), Weights::Factors);
    // Passes of 16, 12, 8 and 4 terms.
    for (rows, inner, columns) in [(37, 64, 100), (5, 588, 33), (12, 40, 4), (1, 4, 2)] {
        for activation in [Activation::None, Activation::Gelu, Activation::SwiGlu] {
            let (layer, x) = (Layer::random(inner, columns), random(3, rows * inner));
            if activation == Activation::SwiGlu && !columns.is_multiple_of(4) {
                continue;
            }
            let all = with_and_without_addresses(device().limits(), has_twin(kernel));
            let products: Vec<_> = all.iter().map(|limits| bits(limits, kernel, &layer, &x, activation)).collect();
            let name = format!("{rows} x {inner} -> {columns} {activation:?}");
            products.iter().for_each(|product| assert_same(&name, product, &products[0]));
        }
    }
}

#[test]
fn tiles_of_gpus() {
    // CPUs get smaller tiles, which compile faster.
    let limits = Limits { cpu: false, ..device().limits().clone() };
    let layer = Layer::random(72, 260);
    for units in [Element::F16, Element::I8].into_iter().filter_map(|factor| Units::of(factor, &limits)) {
        for (index, tile) in Tile::linear(&limits, units).iter().enumerate() {
            let kernel = LinearKernel::Matrix(Units { tiles: Tiles::always(index), ..units }, Weights::Factors);
            println!("{tile}");
            check_kernel(&limits, (kernel, Element::F32), 270, &layer, Activation::Gelu, true, true);
        }
    }
    let x = random(3, 270 * layer.inner);
    let of_tile = |index: usize| {
        let lanes = Lanes { element: Element::F32, tiles: Tiles::always(index) };
        bits(&limits, LinearKernel::Panels(lanes, Weights::Factors), &layer, &x, Activation::Gelu)
    };
    for (index, tile) in LaneTile::candidates(&limits, Element::F32).iter().enumerate().skip(1) {
        assert_same(&tile.to_string(), &of_tile(index), &of_tile(0));
    }
}

#[test]
fn shared_memory_changes_no_bit() {
    // Passes of 8 terms. Some sums, results and panels end within a pass or tile.
    for (rows, inner, columns) in [(37, 64, 100), (5, 588, 33), (50, 40, 4), (1, 4, 2), (3, 2600, 40)] {
        let layer = Layer::random(inner, columns);
        let x = random(3, rows * inner);
        for element in elements() {
            let products = [Tiles::BY_RULE, Tiles::always(1)].map(|tiles| {
                let kernel = LinearKernel::Panels(Lanes { element, tiles }, Weights::Factors);
                bits(device().limits(), kernel, &layer, &x, Activation::Gelu)
            });
            assert_same(&format!("{element:?} {rows} x {inner} -> {columns}"), &products[1], &products[0]);
        }
    }
}

#[test]
fn long_sums_of_few_results_are_cut_into_parts() {
    // Split-K into 1,152, 1,152 and 800 terms; f32 and integer sums stay whole.
    let (rows, inner, columns) = (11, 3104, 40);
    let layer = grouped(inner, columns);
    let x = random(3, rows * inner);
    for kernel in linear_kernels().into_iter().flat_map(|kernel| [Some(kernel), kernel.with_q8()]).flatten() {
        for (activation, added) in [(Activation::Gelu, true), (Activation::SwiGlu, false)] {
            check_kernel(device().limits(), (kernel, Element::F32), rows, &layer, activation, added, added);
        }
        let mut case = Case::new();
        let input = layer.rows(&mut case, kernel, &x);
        let device_layer = layer.input(&mut case, kernel, Activation::None);
        let out = device_layer.apply(&mut case.rec, "out", input, kernel.element(), Epilogue::default()).tensor;
        case.rec.output(out);
        let is_cut = case.rec.finish().unwrap().arena_map().iter().any(|row| row.name.ends_with("sums"));
        assert_eq!(is_cut, Element::HALVES.contains(&kernel.factor()), "{kernel:?}");
    }
}
