use crate::case::*;
use zipsplat::kernels::ops::Im2col;
use zipsplat_tests::reference::ops::im2col::im2col;

fn check(channels: usize, [height, width]: [usize; 2], shape: [usize; 4], out: [usize; 2], padded: usize) {
    let [side, step, padding, spread] = shape;
    let (source, gate) = (random(1, height * width * channels), random(2, height * width * channels));
    let row = (side * side * channels).next_multiple_of(padded);
    let pixels = out[0] * out[1];
    for (first, rectified, gated) in [(0, false, false), (0, true, false), (0, false, true), (pixels / 2, false, true)]
    {
        let count = (pixels - first) * row;
        let mut case = plan();
        let result = case.output::<f32>(count);
        let kernel = Im2col {
            source: case.input(&source),
            gate: case.input(&gate),
            out: result,
            rows: (pixels - first) as u32,
            row: row as u32,
            first: first as u32,
            out_width: out[1] as u32,
            channels: channels as u32,
            width: width as u32,
            height: height as u32,
            source_first: 0,
            side: side as u32,
            step: step as u32,
            padding: padding as u32,
            spread: spread as u32,
            rectified,
            gated,
        };
        case.rec.dispatch_groups(kernel, pixels - first);
        let kept = |(&x, &gate): (&f32, &f32)| match (rectified, gated) {
            (true, _) => x.max(0.0),
            (_, true) if gate <= 0.0 => 0.0,
            _ => x,
        };
        let seen: Vec<f32> = source.iter().zip(&gate).map(kept).collect();
        let rows = rounded(&im2col(&widen(&seen), [width, channels], shape, out));
        let inner = side * side * channels;
        let zeros = vec![0.0; row - inner];
        let truth: Vec<f32> = rows.chunks(inner).skip(first).flat_map(|row| [row, &zeros].concat()).collect();
        let name = format!("{shape:?} of {height} x {width} x {channels} from {first} on, {rectified} {gated}");
        assert_same(&name, &case.result::<f32>(result).unwrap(), &truth);
    }
}

#[test]
fn equals_the_reference() {
    check(3, [7, 9], [3, 1, 1, 1], [7, 9], 4);
    check(64, [5, 4], [3, 1, 1, 1], [5, 4], 4);
    check(3, [35, 31], [11, 4, 2, 1], [8, 7], 4);
    check(5, [4, 6], [5, 1, 2, 1], [4, 6], 8);
    check(2, [1, 1], [1, 1, 0, 1], [1, 1], 1);
}

#[test]
fn zeros_lie_between_pixels_of_transposed_convolutions() {
    check(4, [8, 7], [11, 1, 8, 4], [35, 31], 4);
    check(3, [3, 2], [2, 1, 1, 2], [6, 4], 4);
}

#[test]
fn lines_before_the_bound_ones_count() {
    let (width, channels) = (4, 2);
    let source = random(1, 6 * width * channels);
    let truth = im2col(&widen(&source), [width, channels], [3, 1, 1, 1], [6, 4]);
    let (row, first) = (18, 12);
    let mut case = plan();
    let out = case.output::<f32>(12 * row);
    let part = case.input(&source[2 * width * channels..]);
    let kernel = Im2col {
        source: part,
        gate: part,
        out,
        rows: 12,
        row: row as u32,
        first,
        out_width: 4,
        channels: 2,
        width: 4,
        height: 6,
        source_first: 2,
        side: 3,
        step: 1,
        padding: 1,
        spread: 1,
        rectified: false,
        gated: false,
    };
    case.rec.dispatch_groups(kernel, 12usize);
    assert_same("from the third line on", &case.result::<f32>(out).unwrap(), &rounded(&truth[first as usize * row..]));
}
