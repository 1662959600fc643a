//! Pixel shuffle with bias, exact.

use crate::case::{Case, random, rounded};
use zipsplat::kernels::heads::PixelShuffle;
use zipsplat_tests::compare::assert_same;
use zipsplat_tests::reference::{heads::pixel_shuffle::pixel_shuffle, widen};

#[test]
fn equals_the_reference() {
    for [height, width, side, channels] in [[3, 4, 4, 16], [2, 5, 2, 7], [1, 1, 4, 1], [4, 3, 1, 8]] {
        let (values, bias) = (random(1, height * width * side * side * channels), random(2, channels));
        let mut case = Case::new();
        let out = case.output::<f32>(values.len());
        let kernel = PixelShuffle {
            source: case.input(&values),
            bias: case.input(&bias),
            out,
            count: values.len() as u32,
            width: width as u32,
            side: side as u32,
            channels: channels as u32,
        };
        case.rec.dispatch(kernel, values.len());
        let truth = rounded(&pixel_shuffle(&widen(&values), [width, side], &bias));
        assert_same(&format!("{height} x {width} by {side}"), &case.result::<f32>(out), &truth);
    }
}
