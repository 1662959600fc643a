use crate::case::*;
use zipsplat::kernels::heads::{Convolution, ConvolutionUniform};
use zipsplat::kernels::limits::{LINEAR_ROWS, PANEL_COLUMNS};
use zipsplat::ops::{Lanes, LinearKernel, Weights, pack_matrix};
use zipsplat_tests::{reference::heads::convolution::convolution, reference::ops::activation};

#[derive(Clone, Copy, Debug, Default)]
struct How {
    rectified: bool,
    gelu: bool,
    add: bool,
    add_rectified: bool,
}

/// Checks output lines from `lines.0` on, with source lines from `lines.1` on.
fn check([height, width]: [usize; 2], [channels, columns]: [usize; 2], shape: [usize; 2], how: How, lines: [usize; 2]) {
    let ([side, step], padding) = (shape, shape[0] / 2);
    let inner = side * side * channels;
    let (source, bias) = (random(1, height * width * channels), random(3, columns));
    let weight = random(2, columns * inner);
    let [out_height, out_width] = [height, width].map(|length| (length + 2 * padding - side) / step + 1);
    let first = lines[0] * out_width;
    let pixels = (out_height - lines[0]) * out_width;
    let residual = random(4, pixels * columns);

    let taps = side * side;
    let turned: Vec<f32> = (0..columns * inner)
        .map(|i| weight[i / inner * inner + i % inner % channels * taps + i % inner / channels])
        .collect();
    let weights = pack_matrix(LinearKernel::Panels(Lanes::of(Element::F32), Weights::Factors), &turned, inner, columns);
    let mut case = plan();
    let out = case.output::<f32>(pixels * columns);
    let kernel = Convolution {
        source: case.input(&source[lines[1] * width * channels..]),
        weight: case.input(&weights),
        bias: case.input(&bias),
        residual: case.input(&residual),
        out,
        pixels: pixels as u32,
        first: first as u32,
        out_width: out_width as u32,
        columns: columns as u32,
        channels: channels as u32,
        width: width as u32,
        height: height as u32,
        source_first: lines[1] as u32,
        side: side as u32,
        step: step as u32,
        padding: padding as u32,
        rectified: how.rectified,
        gelu: how.gelu,
        add: how.add,
        add_rectified: how.add_rectified,
    };
    let across = columns.div_ceil(4 * device().limits().subgroup_size as usize);
    case.rec.dispatch_groups(kernel, pixels.div_ceil(LINEAR_ROWS as usize) * across);

    let seen: Vec<f64> = widen(&source).into_iter().map(|x| if how.rectified { x.max(0.0) } else { x }).collect();
    let whole = convolution(&seen, [width, channels], shape, &weight, &bias);
    let active = whole[first * columns..].iter().map(|&x| if how.gelu { activation::gelu(x) } else { x });
    let kept = |r: f32| f64::from(if how.add_rectified { r.max(0.0) } else { r });
    let truth: Vec<f64> =
        if how.add { active.zip(&residual).map(|(x, &r)| x + kept(r)).collect() } else { active.collect() };
    let name = format!("{shape:?} of {height} x {width} x {channels} to {columns} from {lines:?} on, {how:?}");
    assert_close(&name, &case.result::<f32>(out).unwrap(), &truth, Tolerance::sum_of(inner));

    let (limits, vectors) = (device().limits(), 2);
    let tile_columns = vectors * limits.subgroup_size;
    if !limits.addresses || !PANEL_COLUMNS.is_multiple_of(tile_columns) {
        return;
    }
    // Six pixels a workgroup; the last is cut off.
    for (terms, tile_rows) in [(4, 6), (side as u32 * channels as u32, 1)] {
        let mut case = plan();
        let out = case.output::<f32>(pixels * columns);
        let pitch = (width + 2 * padding) * channels;
        let bordered = bordered(&seen, [width, channels], padding);
        let kernel = ConvolutionUniform {
            source: case.input(&bordered[lines[1] * pitch..]),
            weight: case.input(&weights),
            bias: case.input(&bias),
            residual: case.input(&residual),
            out,
            pixels: pixels as u32,
            first: first as u32,
            out_width: out_width as u32,
            columns: columns as u32,
            side: side as u32,
            step: step as u32,
            channels: channels as u32,
            pitch: pitch as u32,
            source_first: lines[1] as u32,
            gelu: how.gelu,
            add: how.add,
            add_rectified: how.add_rectified,
            terms,
            tile_rows,
            vectors,
        };
        let groups = [(pixels as u32).div_ceil(tile_rows), (columns as u32).div_ceil(tile_columns), 1];
        case.rec.dispatch_groups(kernel, groups);
        let name = format!("{name}, by address, {terms} terms of {tile_rows} pixels");
        assert_close(&name, &case.result::<f32>(out).unwrap(), &truth, Tolerance::sum_of(inner));
    }
}

fn bordered(picture: &[f64], [width, channels]: [usize; 2], padding: usize) -> Vec<f32> {
    let line = (width + 2 * padding) * channels;
    let mut out = vec![0.0; padding * line];
    for pixels in picture.chunks(width * channels) {
        let start = out.len() + padding * channels;
        out.resize(out.len() + line, 0.0);
        out[start..start + pixels.len()].iter_mut().zip(pixels).for_each(|(out, x)| *out = *x as f32);
    }
    out.resize(out.len() + padding * line, 0.0);
    out
}

#[test]
fn equals_the_reference() {
    let plain = How::default();
    check([7, 9], [4, 5], [3, 1], plain, [0, 0]);
    check([5, 4], [64, 70], [3, 1], How { rectified: true, add: true, ..plain }, [0, 0]);
    check([5, 4], [16, 20], [3, 1], How { add: true, add_rectified: true, ..plain }, [0, 0]);
    check([7, 6], [12, 24], [3, 2], plain, [0, 0]);
    check([6, 5], [8, 16], [3, 2], How { rectified: true, ..plain }, [0, 0]);
    check([3, 11], [32, 2], [1, 1], How { rectified: true, ..plain }, [0, 0]);
    check([4, 4], [4, 8], [3, 1], How { gelu: true, ..plain }, [0, 0]);
    check([1, 1], [4, 1], [3, 2], plain, [0, 0]);
}

#[test]
fn lines_before_the_bound_ones_count() {
    check([8, 5], [4, 6], [3, 1], How { add: true, ..How::default() }, [3, 2]);
    check([9, 5], [4, 6], [3, 2], How::default(), [2, 3]);
}
