use crate::case::*;
use zipsplat::ops;
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
    let input = Rows::new(case.input(&source), 3, 2);
    ops::place_columns(&mut case.rec, input, Rows::new(out, 3, 5), 1);
    let got: Vec<f32> = case.result(out).unwrap();
    for (row, source) in got.chunks(5).zip(source.chunks(2)) {
        assert_same("columns 1 and 2", &row[1..3], source);
        assert!(row[0].is_nan() && row[3].is_nan() && row[4].is_nan(), "{row:?}");
    }
}

#[test]
fn takes_rows_of_groups() {
    let ([groups, group, width], [first, kept]) = ([3, 7, 5], [2, 4]);
    let source = random(4, groups * group * width);
    let mut case = plan();
    let out = case.output::<f32>(groups * kept * width);
    let input = Rows::new(case.input(&source), groups * group, width);
    let result = Rows::new(out, groups * kept, width);
    ops::place_groups(&mut case.rec, input, [first, kept, group], result, 0);
    let of_group = |rows: &[f32]| rows[first * width..(first + kept) * width].to_vec();
    let truth: Vec<f32> = source.chunks(group * width).flat_map(of_group).collect();
    assert_same("rows", &case.result::<f32>(out).unwrap(), &truth);
}
