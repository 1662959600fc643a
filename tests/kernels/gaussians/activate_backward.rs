use crate::case::*;
use zipsplat::kernels::gaussians::ActivateBackward;
use zipsplat_tests::{
    reference::gaussians::activate::activate, reference::gaussians::activate_backward::activate_backward,
};

/// d loss / d raw, `[count, width]`, in groups of `group` with `padding` behind each.
fn backward(raw: &[f32], d: &[f32], width: usize, group: usize, padding: usize) -> Vec<f32> {
    let count = raw.len() / width;
    let field = |start, end| columns(d, width, start, end).into_iter().map(|x| x as f32).collect::<Vec<_>>();
    let mut case = plan();
    let stride = group * width + padding;
    let d_raw = case.output::<f32>(count / group * stride);
    let kernel = ActivateBackward {
        raw: case.input(raw),
        unit: case.input(&[1.0f32]),
        d_means: case.input(&field(0, 3)),
        d_scales: case.input(&field(3, 6)),
        d_quats: case.input(&field(6, 10)),
        d_opacities: case.input(&field(10, 11)),
        d_sh_coeffs: case.input(&field(11, width)),
        d_raw,
        count: count as u32,
        bases: (width as u32 - 11) / 3,
        group: group as u32,
        stride: stride as u32,
    };
    case.rec.dispatch(kernel, count);
    let rows = case.result::<f32>(d_raw).unwrap();
    assert!(rows.chunks(stride).all(|row| row[group * width..].iter().all(|x| x.is_nan())), "padding is not written");
    rows.chunks(stride).flat_map(|row| row[..group * width].to_vec()).collect()
}

fn truth(raw: &[f32], d: &[f32], width: usize) -> Vec<f64> {
    let pairs = raw.chunks(width).zip(d.chunks(width));
    pairs.flat_map(|(raw, d)| activate_backward(&widen(raw), &widen(d))).collect()
}

#[test]
fn equals_the_reference() {
    for width in [14, 23, 38, 59] {
        for (count, group, padding) in [(1, 1, 0), (64, 2, 2), (333, 3, 1)] {
            let raw: Vec<f32> = random(1, count * width).iter().map(|x| 6.0 * x).collect();
            let d = random(2, count * width);
            let got = backward(&raw, &d, width, group, padding);
            // Short quaternions have a large gradient, and exp reaches e^5.
            let tolerance = |_: &str| Tolerance::EXPONENTIAL;
            assert_gaussians_within(
                &format!("{count} of width {width}"),
                &got,
                &truth(&raw, &d, width),
                width,
                tolerance,
            );
        }
    }
}

#[test]
fn nothing_passes_a_clamp() {
    let mut raw = vec![0.0f32; 3 * 14];
    for (gaussian, x) in [-100.0, 100.0, 5.1].into_iter().enumerate() {
        raw[14 * gaussian..][..6].fill(x);
    }
    let got = backward(&raw, &[1.0; 3 * 14], 14, 1, 0);
    assert_eq!([&got[..6], &got[14..20], &got[28..31]].concat(), [0.0; 15]);
    assert!(got[31] > 0.7, "a scale of 1.4 is not clamped");
}

#[test]
fn the_reference_has_the_gradient_of_activations() {
    let raw: Vec<f64> = random(4, 23).iter().map(|x| 3.0 * f64::from(*x)).collect();
    let (d, direction) = (widen(&random(5, 23)), widen(&random(6, 23)));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let moved =
        |step: f64| dot(&activate(&raw.iter().zip(&direction).map(|(x, v)| x + step * v).collect::<Vec<_>>()), &d);
    let (slope, difference) = (dot(&activate_backward(&raw, &d), &direction), (moved(1e-5) - moved(-1e-5)) / 2e-5);
    assert!((slope - difference).abs() < 1e-8 * slope.abs().max(1.0), "{slope}, by differences {difference}");
}
