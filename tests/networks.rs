use crate::{architectures, device::device, golden::Golden};
use std::ops::ControlFlow;
use zipsplat::{
    gpu::{Device, Run, Tensor},
    ops::{Arithmetic, Precision},
    reconstruct::{Model, Ratio, ReconstructOptions, Reconstruction, TokenSelection},
    types::Image,
    weights::Checkpoint,
};

pub fn fast_arithmetics() -> Vec<Arithmetic> {
    let fast = [Precision::Fp16, Precision::Bf16, Precision::Int8];
    let found = fast.into_iter().filter_map(|precision| Arithmetic::of(precision, device().limits()));
    let twice = |a: Arithmetic| {
        let lanes = Arithmetic { linear: None, attention: None, nearest: None, quantized: None, ..a };
        let on_units = [a.linear, a.attention, a.quantized].iter().any(Option::is_some);
        let can_do_without = on_units && lanes.has_integers() == a.has_integers();
        [Some(a), can_do_without.then_some(lanes)].into_iter().flatten()
    };
    found.flat_map(twice).collect()
}

/// Generated weights, as in the goldens.
pub fn model(config: &str, arithmetic: Arithmetic) -> Model {
    model_on(device(), config, arithmetic)
}

pub fn model_on(device: &Device, config: &str, arithmetic: Arithmetic) -> Model {
    let key = if config == "tiny_rect" { "tiny" } else { config };
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden(config), key).expect("a golden's network");
    let progress = |_| ControlFlow::Continue(());
    Model::from_checkpoint_with(device, &checkpoint, arithmetic, progress).expect("small models fit")
}

pub fn images(golden: &Golden) -> Vec<Image> {
    let (shape, values) = (golden.shape("in/images_u8"), golden.u8("in/images_u8"));
    let (height, width) = (shape[2], shape[3]);
    let area = height * width;
    let picture = |view: &[u8]| {
        let rgb = (0..area).flat_map(|i| [view[i], view[area + i], view[2 * area + i]]).collect();
        Image::new(width as u32, height as u32, rgb).expect("golden images are whole")
    };
    values.chunks(3 * area).map(picture).collect()
}

/// At the network's scale, without pooling.
pub fn options(ratio: f64, token_selection: TokenSelection) -> ReconstructOptions {
    let ratio = Ratio::Fixed(ratio);
    ReconstructOptions { ratio, token_selection, scene_scale: Some(1.0), ..ReconstructOptions::default() }
}

#[track_caller]
pub fn reconstruct(model: &Model, images: &[Image], options: &ReconstructOptions) -> Reconstruction {
    model.reconstruct_views(images, options, |_| ControlFlow::Continue(())).expect("a scene")
}

/// Keeps every observed tensor.
pub fn observe(model: &Model, images: &[Image], options: &ReconstructOptions) -> Run {
    let shape = model.shape(images, options).unwrap();
    let (plan, tensors) = model.record(shape, true).unwrap();
    let mut run = model.run(plan).unwrap();
    model.write_inputs(&mut run, &tensors, shape, images, options).unwrap();
    run.execute().unwrap();
    run
}

#[track_caller]
pub fn observed(run: &Run, name: &str) -> Tensor {
    run.observed().iter().find(|(other, _)| other == name).expect("it is observed").1
}
