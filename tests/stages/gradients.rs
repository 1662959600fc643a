//! Gradients from pictures to tokens, and descent, against PyTorch.

use std::sync::Arc;
use zipsplat::refine::{Adam, Space, record_adam};
use zipsplat::stages::loss::{Loss, LossTensors, record_loss};
use zipsplat::stages::render::{CameraRows, FrameInputs, FrameShape, Gradients, SceneTensors, camera_rows};
use zipsplat::{gpu::Resident, ops::ParameterLayout, ops::place_columns, stages::gaussians::Head};
use zipsplat_tests::prelude::*;
use zipsplat_tests::{
    reference::gaussians::activate::activate, reference::ops::activation::gelu, reference::ops::linear::linear,
};

const LOSSES: [(Loss, &str); 4] =
    [(Loss::L1, "l1"), (Loss::Mse, "mse"), (Loss::Dssim, "dssim_same"), (Loss::L1Dssim, "l1_dssim_3dgs")];

fn goldens() -> impl Iterator<Item = Golden> {
    golden::list("grad_head").into_iter().filter_map(|file| Golden::open(&file))
}

fn head(golden: &Golden) -> (Head, Arc<Resident>) {
    let config = golden.metadata("config");
    load(&Checkpoint::seeded_architecture(architectures::golden(config), config).expect("a golden's network"))
}

fn load(checkpoint: &Checkpoint) -> (Head, Arc<Resident>) {
    let mut parameters = ParameterLayout::new(device().limits(), Arithmetic::EXACT);
    let head = Head::new(&mut parameters, checkpoint.architecture());
    let loaded = parameters.load(device(), &**checkpoint, |_| ControlFlow::Continue(())).expect("a small head fits");
    (head, loaded.resident)
}

/// Golden keys lie below `stem`.
fn check_observed(golden: &Golden, run: &Run, stem: &str, names: &[(&str, f64)]) {
    for (name, tolerance) in names {
        let (_, tensor) =
            run.observed().iter().find(|(path, _)| path.rsplit('/').next() == Some(name)).expect("observed");
        let key = format!("{stem}/{name}");
        let got = run.read::<f32>(*tensor).unwrap();
        let found =
            assert_close(&format!("{} {key}", golden.file()), &got, &golden.f64(&key), Tolerance::rms(*tolerance));
        println!("{key}: {:.1e}", found.rms);
    }
}

#[test]
fn through_the_head() {
    for golden in goldens() {
        let (head, resident) = head(&golden);
        let (count, width) = (golden.shape("step0/gauss")[0], golden.shape("step0/gauss")[1]);
        let ends = [0, 3, 6, 10, 11, width];
        for stem in golden.stems("/d_gauss") {
            let mut rec = Recorder::new(device().limits()).observing();
            let shape = golden.shape("tokens");
            let tokens = rec.input::<f32>("tokens", shape[0] * shape[1]);
            let unit = rec.input::<f32>("unit", 1);
            let scene = SceneTensors::output(&mut rec, count, 1);
            let kept = head.record(&mut rec, Rows::new(tokens, shape[0], shape[1]), unit, &scene);
            let d = [0, 1, 2, 3, 4].map(|i| rec.input::<f32>("d", count * (ends[i + 1] - ends[i])));
            let d_gaussians = SceneTensors::of(d, count, 1);
            head.record_backward(&mut rec, &kept, &d_gaussians);
            let mut run = Run::with_resident(device(), rec.finish().unwrap(), Some(resident.clone())).unwrap();
            run.write(tokens, &golden.f32("tokens")).unwrap();
            run.write(unit, &[1.0f32]).unwrap();
            for (i, tensor) in d.into_iter().enumerate() {
                let values = columns(&golden.f32(&format!("{stem}/d_gauss")), width, ends[i], ends[i + 1]);
                run.write(tensor, &values.iter().map(|x| *x as f32).collect::<Vec<_>>()).unwrap();
            }
            run.execute().unwrap();
            check_observed(&golden, &run, "step0", &[("raw", 5e-6)]);
            check_observed(&golden, &run, &stem, &[("d_raw", 5e-5), ("d_tokens", 5e-5)]);
        }
    }
}

fn raw_of(checkpoint: &Checkpoint, tokens: &[f64]) -> Vec<f64> {
    let read = |name: &str| {
        let name = format!("gaussian_head.gaussian_head.{name}");
        let mut values = vec![0.0; checkpoint.shape(&name).unwrap().iter().product()];
        checkpoint.read_f32(&name, &mut values).unwrap();
        values
    };
    let layer = |name: &str, x: &[f64]| linear(x, &read(&format!("{name}.weight")), &read(&format!("{name}.bias")));
    let hidden: Vec<f64> = layer("0.fc1", tokens).into_iter().map(gelu).collect();
    layer("1", &layer("0.fc2", &hidden))
}

/// 46 values per token of `pico`.
#[test]
fn through_a_head_of_odd_width() {
    let checkpoint = Checkpoint::seeded_architecture(architectures::pico(), "pico").unwrap();
    let (head, resident) = load(&checkpoint);
    let (count, width, wave) = (3, 24, |i: usize| (i as f32 * 0.7).sin());
    let tokens: Vec<f32> = (0..count * width).map(wave).collect();
    let mut rec = Recorder::new(device().limits());
    let input = rec.input::<f32>("tokens", tokens.len());
    let unit = rec.input::<f32>("unit", 1);
    let scene = SceneTensors::output(&mut rec, 2 * count, 1);
    let kept = head.record(&mut rec, Rows::new(input, count, width), unit, &scene);
    let widths = [3, 3, 4, 1, 12];
    let d = widths.map(|width| rec.input::<f32>("d", 2 * count * width));
    let d_gaussians = SceneTensors::of(d, 2 * count, 1);
    let d_tokens = head.record_backward(&mut rec, &kept, &d_gaussians);
    rec.output(d_tokens);
    let mut run = Run::with_resident(device(), rec.finish().unwrap(), Some(resident)).unwrap();
    run.write(input, &tokens).unwrap();
    run.write(unit, &[1.0f32]).unwrap();
    let weights = widths.map(|width| (0..2 * count * width).map(wave).collect::<Vec<f32>>());
    d.iter().zip(&weights).for_each(|(tensor, weights)| run.write(*tensor, weights).unwrap());
    run.execute().unwrap();

    let loss = |tokens: &[f64]| {
        let gaussians: Vec<f64> = raw_of(&checkpoint, tokens).chunks(23).flat_map(activate).collect();
        let ends = [0, 3, 6, 10, 11, 23];
        let field = |i: usize| columns(&gaussians, 23, ends[i], ends[i + 1]);
        (0..5).map(|i| field(i).iter().zip(&weights[i]).map(|(x, w)| x * f64::from(*w)).sum::<f64>()).sum::<f64>()
    };
    let slope = |i: usize| {
        let moved = |step: f64| {
            let mut tokens = widen(&tokens);
            tokens[i] += step;
            loss(&tokens)
        };
        (moved(1e-5) - moved(-1e-5)) / 2e-5
    };
    let truth: Vec<f64> = (0..tokens.len()).map(slope).collect();
    assert_close("d_tokens", &run.read::<f32>(d_tokens).unwrap(), &truth, Tolerance::rms(1e-5));
}

struct Steps {
    run: Run,
    tokens: Tensor,
    schedule: Tensor,
    losses: Tensor,
    frames: Tensor,
    status: Tensor,
}

struct Inputs {
    tokens: Rows,
    unit: Tensor,
    moments: [Tensor; 2],
    schedule: Tensor,
    cameras: Tensor,
    targets: Tensor,
}

fn record_gradient(
    rec: &mut Recorder,
    head: &Head,
    inputs: &Inputs,
    gaussians: usize,
    shape: FrameShape,
    loss: Loss,
) -> (Tensor, LossTensors, Tensor, Tensor) {
    let scene = SceneTensors::output(rec, gaussians, 1);
    let kept = head.record(rec, inputs.tokens, inputs.unit, &scene);
    let d = [3, 3, 4, 1, 12].map(|width| rec.tensor::<f32>("d_gaussians", gaussians * width));
    d.iter().for_each(|tensor| rec.fill(*tensor, 0));
    let d_gaussians = SceneTensors::of(d, gaussians, 1);
    let gradients = Gradients { scene: Some(d_gaussians), cameras: None };
    let mut losses = None;
    let compared = |rec: &mut Recorder, frames: Tensor| {
        let found = record_loss(rec, loss, frames, inputs.targets, shape, 3, 1.0 / shape.cameras as f32);
        rec.observe("d_rgb", found.d_frames);
        losses = Some(found);
        found.d_frames
    };
    let options = &RenderOptions::default();
    let frames = FrameInputs { scene: &scene, cameras: inputs.cameras, shape, options, capacity: 1 << 16 };
    let (drawn, _) = frames.record_with_gradients(rec, compared, &gradients);
    rec.output(drawn.frames);
    let d_tokens = head.record_backward(rec, &kept, &d_gaussians);
    (d_tokens, losses.expect("compared"), drawn.frames, drawn.status)
}

impl Steps {
    fn new(golden: &Golden, loss: Loss, scene_only: bool) -> Self {
        let (head, resident) = head(golden);
        let (count, width) = (golden.shape("tokens")[0], golden.shape("tokens")[1]);
        let (cameras, size) = (golden_cameras(golden), golden.u32("size_wh"));
        let shape = FrameShape { cameras: cameras.len(), width: size[0], height: size[1] };
        let mut rec = Recorder::new(device().limits()).observing();
        let inputs = Inputs {
            tokens: Rows::new(rec.constant::<f32>("tokens", count * width), count, width),
            unit: rec.constant::<f32>("unit", 1),
            moments: [0, 1].map(|_| rec.constant::<f32>("moments", count * width)),
            schedule: rec.input::<f32>("schedule", 4),
            cameras: rec.constant::<CameraRows>("cameras", cameras.len()),
            targets: rec.constant::<f32>("targets", golden.f32("target").len()),
        };
        let gaussians = golden.shape("step0/gauss")[0];
        let (d_tokens, losses, frames, status) = record_gradient(&mut rec, &head, &inputs, gaussians, shape, loss);
        if scene_only {
            let zeros = rec.tensor::<f32>("zeros", count * width / 2);
            rec.fill(zeros, 0);
            let (zeros, tokens) = (Rows::new(zeros, count, width / 2), Rows::new(d_tokens, count, width));
            place_columns(&mut rec, zeros, tokens, width / 2);
        }
        let Inputs { tokens: Rows { tensor: tokens, .. }, moments, schedule, .. } = inputs;
        let adam = Adam::default();
        record_adam(&mut rec, adam, tokens, d_tokens, moments, schedule, 1.0, Space::Linear, count * width);
        [tokens, losses.value].iter().for_each(|tensor| rec.output(*tensor));
        let mut run = Run::with_resident(device(), rec.finish().unwrap(), Some(resident)).unwrap();
        run.write(tokens, &golden.f32("tokens")).unwrap();
        moments.iter().for_each(|moment| run.write(*moment, &vec![0.0f32; count * width]).unwrap());
        run.write(inputs.cameras, &cameras.iter().map(camera_rows).collect::<Vec<_>>()).unwrap();
        run.write(inputs.unit, &[golden.f64("unit")[0] as f32]).unwrap();
        run.write(inputs.targets, &golden.f32("target")).unwrap();
        Self { run, tokens, schedule, losses: losses.value, frames, status }
    }

    /// Counts from 1; returns the loss before.
    fn step(&mut self, step: u32, rate: f32) -> f64 {
        self.run.write(self.schedule, &Adam::default().schedule(rate, step)).unwrap();
        self.run.execute().unwrap();
        let status = self.run.read::<u32>(self.status).unwrap();
        assert_eq!((status[0], status[2]), (status[1], 0), "all intersections are drawn");
        let losses = self.run.read::<f32>(self.losses).unwrap();
        losses.iter().map(|x| f64::from(*x)).sum::<f64>() / losses.len() as f64
    }
}

#[test]
fn from_pictures_to_tokens() {
    for golden in goldens() {
        for (loss, name) in LOSSES {
            let mut steps = Steps::new(&golden, loss, false);
            let value = steps.step(1, 0.0);
            let stem = format!("step0/{name}");
            assert_close(&stem, &[value], &golden.f64(&format!("{stem}/loss")), Tolerance::rms(1e-5));
            let frames = steps.run.read::<f32>(steps.frames).unwrap();
            assert_close("rgb", &frames, &golden.f32("step0/rgb"), Tolerance::rms(3e-5));
            check_observed(&golden, &steps.run, &stem, &[("d_rgb", 3e-5), ("d_raw", 5e-5), ("d_tokens", 5e-5)]);
        }
    }
}

/// 20 steps' losses, and some tokens relative to their change.
fn check_steps(golden: &Golden, stem: &str, mut steps: Steps, rate: f32, [of_loss, of_change]: [f64; 2]) {
    let (start, key) = (golden.f64("tokens"), |name: &str| format!("{stem}/{name}"));
    let change = |tokens: Vec<f64>| tokens.iter().zip(&start).map(|(a, b)| a - b).collect::<Vec<f64>>();
    let mut losses = Vec::new();
    for step in 1..=21 {
        losses.push(steps.step(step, rate));
        let name = format!("tokens{step}");
        if golden.has(&key(&name)) {
            let got = steps.run.read::<f32>(steps.tokens).unwrap().into_iter().map(f64::from).collect();
            let found =
                assert_close(&key(&name), &change(got), &change(golden.f64(&key(&name))), Tolerance::rms(of_change));
            println!("{}: {:.1e} of the change", key(&name), found.rms);
        }
    }
    for (step, (got, truth)) in losses.iter().zip(golden.f64(&key("loss"))).enumerate() {
        assert!((got - truth).abs() <= of_loss * truth, "{stem}: loss {step} is {got}, truth {truth}");
    }
    println!("{stem}: loss {} to {}", losses[0], losses[20]);
}

#[test]
fn twenty_steps_against_squares() {
    for golden in goldens() {
        check_steps(&golden, "adam_mse", Steps::new(&golden, Loss::Mse, false), 0.003, [1e-5, 1e-3]);
    }
}

#[test]
fn twenty_steps_of_scene_tokens() {
    for golden in goldens() {
        check_steps(&golden, "adam_l1_scene", Steps::new(&golden, Loss::L1, true), 0.01, [3e-3, 5e-2]);
    }
}
