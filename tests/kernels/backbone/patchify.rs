use crate::case::*;
use zipsplat::kernels::backbone::Patchify;
use zipsplat_tests::reference::backbone::patchify::{Images, patchify};

#[test]
fn equals_the_reference() {
    // (views, patch rows, patch columns, patch); the last exceeds 65,535 workgroups.
    let shapes =
        [(0, 1, 1, 2), (1, 1, 1, 1), (1, 1, 1, 14), (2, 3, 5, 4), (3, 5, 2, 7), (1, 21, 1, 1), (2, 60, 60, 14)];
    for (views, rows, columns, patch) in shapes {
        let (height, width) = (rows * patch, columns * patch);
        let values = random(1, views * 3 * height * width);
        let truth = patchify(&Images { values: widen(&values), views, height, width }, patch);
        let row = 3 * patch * patch;
        for (output, padding) in elements().into_iter().flat_map(|output| [(output, 0), (output, 4)]) {
            let (mut case, stride) = (plan(), row + padding);
            let len = values.len() / row * stride;
            let out = case.output_of(output, len);
            let kernel = Patchify {
                images: case.input(&values),
                out,
                rows: (len / stride) as u32,
                height: height as u32,
                width: width as u32,
                stride: stride as u32,
                patch: patch as u32,
                normalized: false,
                output,
            };
            case.rec.dispatch_groups(kernel, len / stride);
            let name = format!("{views} views of {rows} x {columns} patches of {patch}, {output:?} + {padding}");
            let padded: Vec<f64> = truth.chunks(row).flat_map(|patch| [patch, &vec![0.0; padding]].concat()).collect();
            assert_same(&name, &case.result_of(output, out).unwrap(), &stored(output, rounded(&padded)));
        }
    }
}

#[test]
fn normalizes_channels() {
    let (patch, [height, width]) = (14, [28, 42]);
    let values: Vec<f32> = random(1, 3 * height * width).iter().map(|x| 0.5 + 0.5 * x).collect();
    let images = Images { values: widen(&values), views: 1, height, width };
    let mut case = plan();
    let out = case.output::<f32>(values.len());
    let (rows, row) = (6, 3 * patch * patch);
    let kernel = Patchify {
        images: case.input(&values),
        out,
        rows,
        height: height as u32,
        width: width as u32,
        stride: row as u32,
        patch: patch as u32,
        normalized: true,
        output: Element::F32,
    };
    case.rec.dispatch_groups(kernel, rows);
    let truth = patchify(&images.normalized(), patch);
    assert_close("normalized", &case.result::<f32>(out).unwrap(), &truth, Tolerance::ELEMENTWISE);
}
