use crate::case::*;
use zipsplat::kernels::lpips::{Normalize, NormalizeBackward};
use zipsplat_tests::reference::lpips::normalize as reference;

/// Returns pictures `[pixels, channels]` with values at and beyond 0 and 1, and their RGB.
fn picture(pixels: usize, channels: usize) -> (Vec<f32>, Vec<f32>) {
    let all: Vec<f32> = random(1, pixels * channels).iter().map(|x| ((0.5 + 0.8 * x) * 16.0).round() / 16.0).collect();
    let rgb = all.chunks(channels).flat_map(|pixel| pixel[..3].to_vec()).collect();
    (all, rgb)
}

#[test]
fn equals_the_reference() {
    for (pixels, channels, clipped) in [(1, 3, false), (77, 3, true), (77, 5, true), (130, 4, false)] {
        let (all, rgb) = picture(pixels, channels);
        let mut case = plan();
        let (out, count) = (case.output::<f32>(3 * pixels), 3 * pixels);
        let kernel =
            Normalize { source: case.input(&all), out, count: count as u32, channels: channels as u32, clipped };
        case.rec.dispatch(kernel, count);
        let truth = reference::normalize(&widen(&rgb), clipped);
        assert_close("normalized", &case.result::<f32>(out).unwrap(), &truth, Tolerance::ELEMENTWISE);
    }
}

#[test]
fn gradients_are_added_where_values_are_not_clipped() {
    for (pixels, channels, clipped) in [(77, 3, true), (77, 5, true), (130, 4, false)] {
        let (all, rgb) = picture(pixels, channels);
        let (d, before) = (random(2, 3 * pixels), random(3, pixels * channels));
        let mut case = plan();
        let d_source = case.input(&before);
        let kernel = NormalizeBackward {
            source: case.input(&all),
            d_out: case.input(&d),
            d_source,
            count: 3 * pixels as u32,
            channels: channels as u32,
            weight: 0.25,
            clipped,
        };
        case.rec.dispatch(kernel, 3 * pixels);
        let gradient = reference::normalize_backward(&widen(&rgb), &widen(&d), clipped);
        let mut truth = widen(&before);
        let places = (0..pixels).flat_map(|pixel| (0..3).map(move |c| pixel * channels + c));
        places.zip(&gradient).for_each(|(place, gradient)| truth[place] += 0.25 * gradient);
        assert_close("gradient", &case.result::<f32>(d_source).unwrap(), &truth, Tolerance::ELEMENTWISE);
    }
}
