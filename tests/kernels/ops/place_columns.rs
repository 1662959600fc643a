use crate::case::*;
use zipsplat::{kernels::ops::PlaceColumns, ops};
use zipsplat_tests::reference::ops::place_columns::join_columns;

#[test]
fn equals_joined_rows() {
    // The last exceeds 65,535 workgroups for the left part.
    for (rows, left_width, right_width) in [(0, 3, 2), (1, 1, 1), (63, 1, 4), (13, 5, 7), (64, 1, 1), (65_537, 65, 1)] {
        let (left, right) = (random(1, rows * left_width), random(2, rows * right_width));
        let truth = rounded(&join_columns(&widen(&left), left_width, &widen(&right), right_width));
        for output in elements() {
            let mut case = plan();
            let parts = [(&left, left_width), (&right, right_width)];
            let parts = parts.map(|(values, width)| Rows::new(case.input(values), rows, width));
            let out = ops::join_columns(&mut case.rec, parts, output).tensor;
            let name = format!("{rows} rows of {left_width} + {right_width} {output:?}");
            assert_same(&name, &case.result_of(output, out).unwrap(), &stored(output, truth.clone()));
        }
    }
}

#[test]
fn what_a_type_cannot_hold_saturates() {
    let values = [f32::MAX, -f32::MAX, 3.39e38, -7e4, 65519.0, 1e-3];
    for output in elements() {
        let mut case = plan();
        let parts = [&values[..3], &values[3..]].map(|values| Rows::new(case.input(values), 1, 3));
        let out = ops::join_columns(&mut case.rec, parts, output).tensor;
        let got = case.result_of(output, out).unwrap();
        assert_same(&format!("{output:?}"), &got, &stored(output, values.to_vec()));
        assert!(got.iter().all(|x| x.is_finite()), "{output:?}: {got:?}");
    }
}

#[test]
fn leaves_other_columns_alone() {
    let source = random(3, 6);
    let mut case = plan();
    let out = case.output::<f32>(3 * 5);
    let (source_tensor, output) = (case.input(&source), Element::F32);
    let kernel = PlaceColumns { source: source_tensor, out, count: 6, width: 2, out_width: 5, out_column: 1, output };
    case.rec.dispatch(kernel, 6u32);
    let got: Vec<f32> = case.result(out).unwrap();
    for (row, source) in got.chunks(5).zip(source.chunks(2)) {
        assert_same("columns 1 and 2", &row[1..3], source);
        assert!(row[0].is_nan() && row[3].is_nan() && row[4].is_nan(), "{row:?}");
    }
}
