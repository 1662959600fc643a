use crate::case::*;
use zipsplat::ops::{
    Activation, Epilogue, LaneTile, Lanes, Linear, LinearKernel, Q8, Tile, Tiles, Units, Weights, pack_matrix,
};
use zipsplat_verify::{Layer, Residual};

const ACTIVATIONS: [Activation; 3] = [Activation::None, Activation::Gelu, Activation::SwiGlu];

fn bits(layer: &Layer, kernel: LinearKernel, output: Element) -> Vec<u32> {
    layer.run(device(), kernel, output).unwrap().into_iter().map(f32::to_bits).collect()
}

/// GELU comes with a scale and a residual.
fn layer([rows, inner, columns]: [usize; 3], activation: Activation) -> Layer {
    let mut layer = Layer::random(rows, inner, columns);
    layer.activation = activation;
    if activation == Activation::Gelu {
        (layer.scaled, layer.residual) = (true, Residual::Apart);
    }
    layer
}

fn panels(element: Element, tiles: Tiles) -> LinearKernel {
    LinearKernel::Panels(Lanes { element, tiles }, Weights::Factors)
}

#[test]
fn what_f16_cannot_hold_saturates() {
    let gives_f16 = |kernel: &LinearKernel| kernel.element() != Element::Bf16 && elements().contains(&Element::F16);
    for kernel in linear_kernels().into_iter().filter(gives_f16) {
        for (activation, sign) in [(Activation::None, 1.0), (Activation::None, -1.0), (Activation::SwiGlu, 1.0)] {
            let mut layer = Layer::random(1, 8, 8);
            layer.activation = activation;
            layer.weight.fill(200.0);
            layer.x.fill(100.0 * sign);
            let values = layer.run(device(), kernel, Element::F16).unwrap();
            let (values, _guard) = values.split_at(values.len() / 2);
            assert!(values.iter().all(|x| *x == 65504.0 * sign), "{kernel:?} {activation:?}: {values:?}");
        }
    }
}

#[test]
fn q8_weights_give_the_bits_of_what_they_stand_for() {
    for [kernel, q8] in q8_kernels() {
        let mut layer = Layer::exact(37, 224, 100);
        layer.x = random(3, layer.x.len());
        for (g, group) in layer.weight.chunks_mut(Q8::GROUP).enumerate() {
            group.iter_mut().for_each(|w| *w *= ((g % 3) as f32 - 1.0).exp2());
        }
        if kernel.factor() == Element::F32 {
            // Weights that need f32, in groups of different scales.
            let sized = |(i, x): (usize, f32)| x * 10f32.powi((i / Q8::GROUP % 7) as i32 - 4);
            let values: Vec<f32> = random(1, layer.weight.len()).into_iter().enumerate().map(sized).collect();
            Q8::round(&values).expect("small weights").values(&mut layer.weight);
        }
        let [expected, found] = [kernel, q8].map(|kernel| bits(&layer, kernel, Element::F32));
        assert_same(&format!("{q8:?}"), &found, &expected);
    }
}

#[test]
fn reading_by_address_changes_no_bit() {
    let kernel = panels(Element::F32, Tiles::BY_RULE);
    // Passes of 16, 12, 8 and 4 terms.
    for shape in [[37, 64, 100], [5, 588, 33], [12, 40, 4], [1, 4, 2]] {
        for activation in ACTIVATIONS {
            if activation == Activation::SwiGlu && shape[2] % 4 != 0 {
                continue;
            }
            let mut layer = layer(shape, activation);
            let expected = bits(&layer, kernel, Element::F32);
            layer.limits = |limits| limits.addresses = false;
            assert_same(&format!("{shape:?} {activation:?}"), &bits(&layer, kernel, Element::F32), &expected);
        }
    }
}

#[test]
fn tiles_change_no_bit() {
    let layer = layer([270, 72, 260], Activation::Gelu);
    let units: Vec<Units> = Element::FACTORS.into_iter().filter_map(|f| Units::of(f, device().limits())).collect();
    let matrix = |units| LinearKernel::Matrix(units, Weights::Factors);
    let kernels = units.iter().map(|units| matrix(*units)).chain([panels(Element::F32, Tiles::BY_RULE)]);
    let expected: Vec<_> = kernels.map(|kernel| bits(&layer, kernel, Element::F32)).collect();
    for (units, expected) in units.iter().zip(&expected) {
        for (index, tile) in Tile::linear(device().limits(), *units).iter().enumerate() {
            let kernel = matrix(Units { tiles: Tiles::always(index), ..*units });
            assert_same(&format!("{:?} {tile}", units.factor), &bits(&layer, kernel, Element::F32), expected);
        }
    }
    for (index, tile) in LaneTile::candidates(device().limits(), Element::F32).iter().enumerate() {
        let kernel = panels(Element::F32, Tiles::always(index));
        assert_same(&tile.to_string(), &bits(&layer, kernel, Element::F32), &expected[units.len()]);
    }
}

#[test]
fn shared_memory_changes_no_bit() {
    // Passes of 8 terms. Some sums, results and panels end within a pass or tile.
    for shape in [[37, 64, 100], [5, 588, 33], [50, 40, 4], [1, 4, 2], [3, 2600, 40]] {
        let layer = layer(shape, Activation::Gelu);
        for element in elements() {
            let [plain, tiled] =
                [Tiles::BY_RULE, Tiles::always(1)].map(|tiles| bits(&layer, panels(element, tiles), Element::F32));
            assert_same(&format!("{element:?} {shape:?}"), &tiled, &plain);
        }
    }
}

#[test]
fn long_sums_of_few_results_are_cut_into_parts() {
    // 1,152, 1,152 and 800 terms; f32 and integer sums stay whole.
    let (rows, inner, columns) = (11, 3104, 40);
    for kernel in linear_kernels().into_iter().flat_map(|kernel| [Some(kernel), kernel.with_q8()]).flatten() {
        let mut rec = Recorder::new(device().limits());
        let packed = pack_matrix(kernel, &vec![0.0; inner * columns], inner, columns);
        let (weight, bias) = (rec.input::<u8>("weight", packed.len()), rec.input::<f32>("bias", columns));
        let (layer, element) = (Linear { weight, bias, inner, columns, kernel }, kernel.element());
        let tensor = rec.input::<u8>("input", rows * inner * element.bytes());
        let input = Rows { tensor, count: rows, width: inner, element };
        let out = layer.apply(&mut rec, "out", input, element, Epilogue::default()).tensor;
        rec.output(out);
        let is_cut = rec.finish().unwrap().arena_map().iter().any(|row| row.name.ends_with("sums"));
        assert_eq!(is_cut, Element::HALVES.contains(&kernel.factor()), "{kernel:?}");
    }
}

const DOTS: LinearKernel = LinearKernel::Dots(Tiles::BY_RULE);

#[test]
fn dot_products_give_the_bits_of_matrix_units() {
    let shapes = [[1, 8, 8], [7, 24, 32], [9, 72, 40], [33, 64, 136], [70, 96, 264], [3, 4096, 24], [130, 40, 72]];
    let units = Units::of(Element::I8, device().limits()).filter(|_| device().limits().dot_products);
    for (units, shape) in units.into_iter().flat_map(|units| shapes.map(|shape| (units, shape))) {
        for activation in ACTIVATIONS {
            for output in [Element::F32, Element::F16] {
                let kernels = [LinearKernel::Matrix(units, Weights::Factors), DOTS];
                let [matrix, dots] = kernels.map(|kernel| bits(&layer(shape, activation), kernel, output));
                assert_same(&format!("{shape:?} {activation:?} {output:?}"), &dots, &matrix);
            }
        }
    }
}

#[test]
fn every_tile_of_dot_products_gives_the_same_bits() {
    let limits = device().limits();
    let tiles = if limits.dot_products { LaneTile::candidates(limits, Element::I8) } else { Vec::new() };
    for shape in [[270, 72, 264], [5, 8, 8]] {
        let layer = layer(shape, Activation::Gelu);
        let expected = bits(&layer, DOTS, Element::F32);
        for (index, tile) in tiles.iter().enumerate() {
            let found = bits(&layer, LinearKernel::Dots(Tiles::always(index)), Element::F32);
            assert_same(&format!("{tile} {shape:?}"), &found, &expected);
        }
    }
}

#[test]
fn nan_stays_in_its_row_of_integers() {
    if !device().limits().dot_products {
        return;
    }
    let mut layer = Layer::random(9, 40, 24);
    let clean = bits(&layer, DOTS, Element::F32);
    layer.x[4 * 40 + 17] = f32::NAN;
    let found = layer.run(device(), DOTS, Element::F32).unwrap();
    for (row, (found, clean)) in found.chunks(24).zip(clean.chunks(24)).enumerate() {
        match row {
            4 => assert!(found.iter().all(|x| x.is_nan()), "{found:?}"),
            _ => assert_same(&format!("row {row}"), &found.iter().map(|x| x.to_bits()).collect::<Vec<_>>(), clean),
        }
    }
}
