use crate::case::*;
use zipsplat::kernels::cluster::Origin;
use zipsplat_tests::reference::cluster::origin::origin as reference;

fn origin(rows: &[f32], width: usize, samples: usize) -> Vec<f32> {
    let mut case = plan();
    let out = case.output::<f32>(width);
    let kernel = Origin {
        source: case.input(rows),
        out,
        rows: (rows.len() / width) as u32,
        width: width as u32,
        samples: samples as u32,
    };
    case.rec.dispatch(kernel, width / 4);
    case.result(out).unwrap()
}

#[test]
fn equals_the_reference() {
    for (rows, samples) in [(1, 1), (2, 1), (7, 7), (300, 256), (1000, 256), (1024, 256)] {
        for width in [4, 36, 260, 1536] {
            let values: Vec<f32> = random(1, rows * width).iter().map(|x| x + 1.5).collect();
            let truth = reference(&widen(&values), width, samples);
            let name = format!("{samples} of {rows} x {width}");
            assert_close(&name, &origin(&values, width, samples), &truth, Tolerance::sum_of(samples));
        }
    }
}

#[test]
fn a_mean_of_large_values_is_finite() {
    let largest = vec![f32::MAX; 64 * 4];
    assert_close("f32::MAX", &origin(&largest, 4, 64), &[f64::from(f32::MAX); 4], Tolerance::ELEMENTWISE);
}
