use crate::case::*;
use zipsplat::kernels::lpips::{Pool, PoolBackward};
use zipsplat_tests::reference::lpips::pool as reference;

/// (height, width, channels, side, step); windows ignore the remainder.
const SHAPES: [[usize; 5]; 5] = [[2, 2, 1, 2, 2], [7, 9, 5, 2, 2], [8, 4, 64, 2, 2], [9, 12, 3, 3, 2], [7, 8, 2, 3, 2]];

fn features(len: usize) -> Vec<f32> {
    random(1, len).iter().map(|x| (4.0 * x).round() / 4.0).collect()
}

fn rectified(values: &[f32]) -> Vec<f64> {
    widen(values).into_iter().map(|x| x.max(0.0)).collect()
}

#[test]
fn equals_the_reference() {
    for [height, width, channels, side, step] in SHAPES {
        let source = features(height * width * channels);
        let truth = rounded(&reference::pool(&rectified(&source), [width, channels], side, step));
        let mut case = plan();
        let out = case.output::<f32>(truth.len());
        let kernel = Pool {
            source: case.input(&source),
            out,
            count: truth.len() as u32,
            first: 0,
            out_width: ((width - side) / step + 1) as u32,
            channels: channels as u32,
            width: width as u32,
            source_first: 0,
            side: side as u32,
            step: step as u32,
        };
        case.rec.dispatch(kernel, truth.len());
        assert_same(&format!("{height} x {width}"), &case.result::<f32>(out).unwrap(), &truth);
    }
}

#[test]
fn gradients_go_to_the_first_of_equal_values() {
    for [height, width, channels, side, step] in SHAPES {
        let source = features(height * width * channels);
        let [out_height, out_width] = [height, width].map(|length| (length - side) / step + 1);
        // Sums of eighths are exact in any order.
        let d: Vec<f32> =
            random(2, out_height * out_width * channels).iter().map(|x| (8.0 * x).round() / 8.0).collect();
        let mut case = plan();
        let out = case.output::<f32>(source.len());
        let kernel = PoolBackward {
            source: case.input(&source),
            d_out: case.input(&d),
            d_source: out,
            count: source.len() as u32,
            first: 0,
            out_first: 0,
            out_width: out_width as u32,
            out_height: out_height as u32,
            channels: channels as u32,
            width: width as u32,
            source_first: 0,
            side: side as u32,
            step: step as u32,
        };
        case.rec.dispatch(kernel, source.len());
        let truth = reference::pool_backward(&rectified(&source), [width, channels], side, step, &widen(&d));
        assert_same(&format!("{height} x {width}"), &case.result::<f32>(out).unwrap(), &rounded(&truth));
    }
}
