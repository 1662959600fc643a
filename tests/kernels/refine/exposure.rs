use crate::case::*;
use zipsplat::{refine::Exposed, stages::FrameShape};
use zipsplat_tests::reference::refine::exposure::{exposed, exposure_backward};

/// Frames, partly saturated targets, transforms and gradient of `photos` photos.
fn problem(photos: usize, pixels: usize) -> [Vec<f32>; 4] {
    let frames: Vec<f32> = random(1, 3 * photos * pixels).iter().map(|x| 0.5 + 0.8 * x).collect();
    let targets = random(2, frames.len()).iter().map(|x| (0.5 + x).clamp(0.0, 1.0)).collect();
    let identity = |i: usize| if [0, 5, 10].contains(&(i % 12)) { 1.0 } else { 0.0 };
    let transforms = random(3, 12 * photos).iter().enumerate().map(|(i, x)| identity(i) + 0.3 * x).collect();
    let gradient = random(4, frames.len());
    [frames, targets, transforms, gradient]
}

#[test]
fn parts_give_the_same_bits() {
    let [frames, targets, transforms, gradient] = problem(9, 256);
    let recorded = |limits: &Limits| {
        let mut case = plan_within(limits);
        let inputs = [&frames, &targets, &transforms].map(|values| case.input(values));
        let d_frames = case.input(&gradient);
        let shape = FrameShape { cameras: 9, width: 16, height: 16 };
        let all = Exposed::record(&mut case.rec, inputs, shape);
        let d_transforms = all.record_backward(&mut case.rec, d_frames);
        case.results::<f32, 3>([all.exposed, d_frames, d_transforms]).unwrap()
    };
    let narrow = Limits { max_binding_bytes: 8 << 10, ..device().limits().clone() };
    for (got, truth) in recorded(&narrow).iter().zip(&recorded(device().limits())) {
        assert_same("exposures in parts", got, truth);
    }
}

#[test]
fn the_reference_has_the_gradient_of_its_value() {
    let [frames, targets, transforms, gradient] = problem(1, 50).map(|values| widen(&values));
    let value = |frames: &[f64], transform: &[f64]| {
        exposed(frames, &targets, transform).iter().zip(&gradient).map(|(value, g)| value * g).sum::<f64>()
    };
    let moved = |values: &[f64], by: f64| {
        values.iter().zip((0..).map(|i| f64::from(i).sin())).map(|(x, d)| x + by * d).collect::<Vec<f64>>()
    };
    let along = |values: &[f64]| values.iter().zip((0..).map(|i| f64::from(i).sin())).map(|(g, d)| g * d).sum::<f64>();
    let (d_frames, d_transform) = exposure_backward(&frames, &targets, &transforms, &gradient);
    let step = 1e-6;
    let by_frames =
        (value(&moved(&frames, step), &transforms) - value(&moved(&frames, -step), &transforms)) / (2.0 * step);
    let by_transform =
        (value(&frames, &moved(&transforms, step)) - value(&frames, &moved(&transforms, -step))) / (2.0 * step);
    for (slope, difference) in [(along(&d_frames), by_frames), (along(&d_transform), by_transform)] {
        assert!((slope - difference).abs() < 1e-6 * slope.abs(), "{slope}, by differences {difference}");
    }
}
