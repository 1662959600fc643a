use crate::case::*;
use zipsplat::{kernels::ops::GatherRows, ops};
use zipsplat_tests::reference::ops::gather_rows::gather_rows;

#[test]
fn equals_indexing() {
    // (source rows, result rows, width); the last exceeds 65,535 workgroups.
    for (rows, count, width) in
        [(5, 0, 3), (1, 1, 1), (9, 63, 1), (7, 64, 1), (7, 65, 1), (33, 17, 13), (3, 65_537, 65)]
    {
        let (source, indices) = (random(1, rows * width), random_below(2, count, rows as u32));
        let mut case = plan();
        let out = case.output::<f32>(count * width);
        let kernel = GatherRows {
            source: case.input(&source),
            rows_from_out: case.input(&indices),
            out,
            count: count as u32,
            width: width as u32,
            first_row: 0,
            source_rows: rows as u32,
        };
        case.rec.dispatch(kernel, count * width);
        let truth = rounded(&gather_rows(&widen(&source), width, &indices));
        assert_same(&format!("{count} of {rows} rows of {width}"), &case.result::<f32>(out).unwrap(), &truth);
    }
}

#[test]
fn leaves_rows_of_other_parts_alone() {
    let source = random(1, 2 * 4);
    let mut case = plan();
    let out = case.output::<f32>(4 * 4);
    let indices = case.input(&[9u32, 10, 11, 12]);
    let kernel = GatherRows {
        source: case.input(&source),
        rows_from_out: indices,
        out,
        count: 4,
        width: 4,
        first_row: 10,
        source_rows: 2,
    };
    case.rec.dispatch(kernel, 16u32);
    let got: Vec<f32> = case.result(out).unwrap();
    assert_same("rows 10 and 11", &got[4..12], &source);
    assert!(got[..4].iter().chain(&got[12..]).all(|x| x.is_nan()));
}

#[test]
fn gathers_from_a_source_that_is_bound_in_parts() {
    let (rows, count, width) = (1000, 77, 12);
    let (source, indices) = (random(3, rows * width), random_below(4, count, rows as u32));
    let mut case = plan_within(&Limits { max_binding_bytes: 16 << 10, ..device().limits().clone() });
    let (rows, rows_from_out) = (Rows::new(case.input(&source), rows, width), case.input(&indices));
    let out = ops::gather_rows(&mut case.rec, rows, rows_from_out, count).tensor;
    let truth = rounded(&gather_rows(&widen(&source), width, &indices));
    assert_same("in parts", &case.result::<f32>(out).unwrap(), &truth);
}
