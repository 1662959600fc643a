use crate::case::*;
use zipsplat::kernels::backbone::AverageHalves;
use zipsplat_tests::reference::backbone::average_halves::average_halves;

#[test]
fn equals_the_reference() {
    for (rows, width) in [(0, 4), (1, 1), (21, 3), (8, 8), (13, 5), (65_537, 65)] {
        for input in elements() {
            let halves = stored(input, random(1, rows * 2 * width));
            let mut case = plan();
            let out = case.output::<f32>(rows * width);
            let (halves_tensor, rows32) = (case.input_of(input, &halves), rows as u32);
            let kernel = AverageHalves { halves: halves_tensor, out, rows: rows32, width: width as u32, input };
            case.rec.dispatch(kernel, rows * width);
            let truth = rounded(&average_halves(&widen(&halves), width));
            assert_same(&format!("{rows} x {width} {input:?}"), &case.result::<f32>(out).unwrap(), &truth);
        }
    }
}
