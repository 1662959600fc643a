//! Bilinear resizing with aligned corners, with and without positions, and partial pictures.

use crate::case::{Case, random};
use zipsplat::kernels::heads::Resize;
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::reference::{heads::resize::resize, widen};

/// Checks output lines from `lines.0` on, with source lines from `lines.1` on.
fn check([height, width, channels]: [usize; 3], [out_height, out_width]: [usize; 2], placed: bool, lines: [usize; 2]) {
    let (source, half) = (random(1, height * width * channels), channels / 2);
    let positions = random(2, (out_width + out_height) * half);
    let pixels = (out_height - lines[0]) * out_width;
    let mut case = Case::new();
    let out = case.output::<f32>(pixels * channels);
    let kernel = Resize {
        source: case.input(&source[lines[1] * width * channels..]),
        positions: case.input(&positions),
        out,
        pixels: pixels as u32,
        first: lines[0] as u32,
        out_width: out_width as u32,
        out_height: out_height as u32,
        channels: channels as u32,
        width: width as u32,
        height: height as u32,
        source_first: lines[1] as u32,
        placed,
    };
    case.rec.dispatch_groups(kernel, pixels);
    let mut truth = resize(&widen(&source), [width, channels], [out_height, out_width]);
    if placed {
        for (i, value) in truth.iter_mut().enumerate() {
            let (pixel, channel) = (i / channels, i % channels);
            let axis = if channel < half { pixel % out_width } else { out_width + pixel / out_width };
            *value += f64::from(positions[axis * half + channel % half]);
        }
    }
    let name = format!("{height} x {width} x {channels} to {out_height} x {out_width} from {lines:?} on");
    let truth = &truth[lines[0] * out_width * channels..];
    assert_close(&name, &case.result::<f32>(out), truth, Tolerance::ELEMENTWISE);
}

#[test]
fn equals_the_reference() {
    for placed in [false, true] {
        check([3, 4, 8], [6, 8], placed, [0, 0]);
        check([24, 16, 4], [42, 28], placed, [0, 0]);
        // More channels than lanes of a subgroup, so the last lanes idle.
        check([3, 2, 68], [5, 4], placed, [0, 0]);
        check([1, 2, 4], [2, 3], placed, [0, 0]);
        check([2, 1, 4], [3, 5], placed, [0, 0]);
        check([5, 6, 4], [1, 1], placed, [0, 0]);
        check([5, 6, 4], [5, 6], placed, [0, 0]);
    }
}

#[test]
fn parts_of_pictures_lie_where_they_do_in_the_whole() {
    // Line 5 of 9 lies at 5 * 4 / 8 = 2.5 of the source.
    check([5, 3, 4], [9, 7], true, [5, 2]);
}
