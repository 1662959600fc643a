use crate::case::*;
use zipsplat::ops::Norm;
use zipsplat_tests::reference::ops::layer_norm::layer_norm;
use zipsplat_verify::Trial;

/// Two sums over a row, a root and a division.
fn tolerance(width: usize) -> Tolerance {
    Tolerance::sum_of(width).and(Tolerance::ELEMENTWISE)
}

fn norm(case: &mut Trial<'_>, weight: &[f32], bias: &[f32], eps: f32) -> Norm {
    Norm { weight: case.input(weight), bias: case.input(bias), width: weight.len(), eps }
}

#[test]
fn equals_the_goldens() {
    let golden = Golden::committed("geometry.safetensors");
    let (x, weight, bias) = (golden.f32("ops/ln_x"), golden.f32("ops/ln_w"), golden.f32("ops/ln_b"));
    let width = weight.len();
    for (eps, key) in [(1e-5, "ops/ln_1e-05"), (1e-6, "ops/ln_1e-06")] {
        let mut case = plan();
        let norm = norm(&mut case, &weight, &bias, eps);
        let input = Rows::new(case.input(&x), x.len() / width, width);
        let out = norm.apply(&mut case.rec, input, Element::F32).tensor;
        assert_close(key, &case.result::<f32>(out).unwrap(), &golden.f32(key), tolerance(width));
    }
}

#[test]
fn skips_special_tokens_and_writes_between_other_columns() {
    let (patches, width, stride, column) = (6, 20, 53, 30);
    let (weight, bias) = (random(6, width), random(7, width));
    // The narrow limit splits the rows into parts of 64 views.
    for (views, leading, max_binding_bytes) in [(1, 1, u64::MAX), (3, 5, u64::MAX), (150, 1, 100 << 10)] {
        let x = random(8, views * (leading + patches) * width);
        let limits = device().limits();
        let max_binding_bytes = limits.max_binding_bytes.min(max_binding_bytes);
        let mut case = plan_within(&Limits { max_binding_bytes, ..limits.clone() });
        let norm = norm(&mut case, &weight, &bias, 1e-5);
        let rows = views * patches;
        let input = Rows::new(case.input(&x), views * (leading + patches), width);
        let out = case.output::<f32>(rows * stride);
        norm.record(
            &mut case.rec,
            input,
            None,
            Rows::new(out, rows, stride).columns(column, width),
            [leading, patches],
        );
        let got: Vec<f32> = case.result(out).unwrap();

        let tokens = x.chunks(width).enumerate().filter(|(row, _)| row % (leading + patches) >= leading);
        let kept: Vec<f32> = tokens.flat_map(|(_, token)| token).copied().collect();
        let truth = layer_norm(&widen(&kept), &weight, &bias, 1e-5);
        let written: Vec<f32> = got.chunks(stride).flat_map(|row| &row[column..column + width]).copied().collect();
        assert_close(&format!("{views} views"), &written, &truth, tolerance(width));
        let untouched = got.chunks(stride).all(|r| r[..column].iter().chain(&r[column + width..]).all(|x| x.is_nan()));
        assert!(untouched, "{views} views: other columns were written");
    }
}
