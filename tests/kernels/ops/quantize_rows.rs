//! The nearest, or either in a tie within f32 rounding.

use crate::case::*;
use zipsplat::ops::quantize_rows;
use zipsplat_tests::reference::ops::quantize_rows::quantize_rows as reference;

fn quantized(values: &[f32], rows: usize, width: usize) -> (Vec<f32>, Vec<f32>) {
    let mut case = plan();
    let source = Rows { tensor: case.input_of(Element::F16, values), count: rows, width, element: Element::F16 };
    let (out, scales) = quantize_rows(&mut case.rec, source);
    let out = out.tensor;
    case.rec.output(out);
    case.rec.output(scales);
    let run = case.run().unwrap();
    (Element::I8.decode(&run.read::<u8>(out).unwrap()), run.read(scales).unwrap())
}

fn check(values: Vec<f32>, rows: usize, width: usize) {
    let values = stored(Element::F16, values);
    let (integers, scales) = quantized(&values, rows, width);
    let (truth, units) = reference(&widen(&values), width);
    // Vulkan's division is off by 2.5 ulp, times up to 127.
    let nearest = |(got, truth): (&f32, &f64)| (f64::from(*got) - truth).abs() <= 0.5 + 1e-4;
    let worst = integers.iter().zip(&truth).position(|pair| !nearest(pair));
    assert!(worst.is_none(), "{rows} x {width}: element {worst:?}");
    assert_close(&format!("scales of {rows} x {width}"), &scales, &units, Tolerance::ELEMENTWISE);
}

#[test]
fn rounds_to_the_nearest_of_each_row() {
    if !elements().contains(&Element::F16) {
        return;
    }
    for (rows, width) in [(1, 8), (3, 24), (17, 64), (5, 1536), (66_000, 8)] {
        check(random(1, rows * width), rows, width);
    }
    // Rows of different sizes, one of a single channel.
    let mut values = random(2, 6 * 64);
    for (row, size) in values.chunks_mut(64).zip([1e-4, 1.0, 6e4, 1e-2, 30.0, 500.0]) {
        row.iter_mut().for_each(|x| *x *= size);
    }
    values[130..192].fill(0.0);
    check(values, 6, 64);
}

#[test]
fn zeros_stay_and_nan_is_not_lost() {
    if !elements().contains(&Element::F16) {
        return;
    }
    let mut values = vec![0.0; 3 * 16];
    values[20] = f32::NAN;
    values[40] = -2.0;
    let (integers, scales) = quantized(&values, 3, 16);
    assert!(integers[..16].iter().all(|x| *x == 0.0) && scales[0] == 0.0);
    assert!(scales[1].is_nan(), "{scales:?}");
    assert_eq!(integers[40], -127.0);
}
