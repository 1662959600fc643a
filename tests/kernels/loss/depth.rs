use crate::case::*;
use zipsplat::{
    refine::DepthKind,
    stages::{FrameShape, depth_loss::DepthFrames},
};
use zipsplat_tests::reference::loss::depth::{CHANNELS, depth_loss, line};

/// Of pictures that can be parts of bindings.
const SHAPE: FrameShape = FrameShape { cameras: 3, width: 32, height: 12 };

fn frames_and_targets() -> [Vec<f32>; 2] {
    let pixels = SHAPE.cameras * (SHAPE.width * SHAPE.height) as usize;
    let targets: Vec<f32> = random(2, pixels).iter().map(|x| if *x > 0.8 { 0.0 } else { 1.5 + x }).collect();
    let noise = random(3, CHANNELS * pixels);
    let value = |(i, x): (usize, &f32)| match i % CHANNELS {
        3 => 0.7 + 0.3 * x,
        4 => 1.0 / (1.0 + targets[i / CHANNELS] + 0.4 * x),
        _ => *x,
    };
    [noise.iter().enumerate().map(value).collect(), targets]
}

fn compared(limits: &Limits, kind: DepthKind) -> Vec<f32> {
    let ([frames, targets], mut case) = (frames_and_targets(), plan_within(limits));
    let d_colors = random(4, 3 * targets.len());
    let [frames, targets, d_colors] = [&frames, &targets, &d_colors].map(|values| case.input(values));
    let weight = case.input(&[0.5f32]);
    let split = DepthFrames::record(&mut case.rec, [frames, targets], SHAPE);
    let [value, d_frames] = split.record_backward(&mut case.rec, d_colors, weight, kind);
    case.results([split.colors, value, d_frames]).unwrap().concat()
}

#[test]
fn parts_give_the_same_bits() {
    let narrow = Limits { max_binding_bytes: 8192, ..device().limits().clone() };
    let [metric, relative] = [DepthKind::Metric, DepthKind::Relative].map(|kind| {
        let whole = compared(device().limits(), kind);
        assert_same("depth losses in parts", &compared(&narrow, kind), &whole);
        whole
    });
    assert_ne!(metric, relative);
}

#[test]
fn gradients_are_those_of_differences() {
    let [frames, targets] = frames_and_targets().map(|values| widen(&values));
    for line in [Some([1.0, 0.0]), line(&frames, &targets), None] {
        let (_, gradient) = depth_loss(&frames, &targets, line);
        for pixel in (0..targets.len()).step_by(31) {
            let loss = |step: f64| {
                let mut moved = frames.clone();
                moved[CHANNELS * pixel + 4] += step;
                depth_loss(&moved, &targets, line).0
            };
            let difference = (loss(1e-6) - loss(-1e-6)) / 2e-6;
            assert!((difference - gradient[pixel]).abs() < 1e-6, "{pixel}: {difference}, {}", gradient[pixel]);
        }
    }
}
