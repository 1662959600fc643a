//! The same inputs give the same bits, every run and on every opening of a device.

use zipsplat::gpu::{Device, DeviceOptions};
use zipsplat::reconstruct::{Model, Ratio, Request};
use zipsplat::types::{Image, Scene};
use zipsplat::weights::Checkpoint;
use zipsplat_tests::{architectures, compare::assert_same, device::device};

/// Two views of 4 x 5 patches of noise.
fn images() -> Vec<Image> {
    let (width, height) = (5 * 14, 4 * 14);
    let view = |seed: u32| {
        let rgb = (0..3 * width * height).map(|i| ((i + seed).wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        Image::new(width, height, rgb).unwrap()
    };
    vec![view(1), view(1 << 20)]
}

fn model(device: &Device) -> Model {
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").unwrap();
    Model::load(device, &checkpoint, |_| ()).unwrap()
}

fn reconstruct(model: &Model) -> Scene {
    let request = Request { ratio: Ratio::Fixed(0.5), ..Request::default() };
    model.reconstruct(&images(), &request, |_| std::ops::ControlFlow::Continue(())).unwrap().scene
}

fn bits(scene: &Scene) -> Vec<u32> {
    let fields = [scene.means.as_flattened(), scene.scales.as_flattened(), scene.quats.as_flattened()];
    let fields = fields.into_iter().chain([&scene.opacities[..], scene.sh_coeffs.as_flattened()]);
    fields.flatten().map(|x| x.to_bits()).collect()
}

#[test]
fn every_run_gives_the_same_bits() {
    let model_here = model(device());
    let first = bits(&reconstruct(&model_here));
    assert!(!first.is_empty());
    assert_same("again", &bits(&reconstruct(&model_here)), &first);
    let elsewhere = Device::open(&DeviceOptions::default()).unwrap();
    assert_same("on another opening of the device", &bits(&reconstruct(&model(&elsewhere))), &first);
}

#[test]
fn observing_changes_no_bit() {
    let model = model(device());
    let request = Request { ratio: Ratio::Fixed(0.5), ..Request::default() };
    let shape = model.shape(&images(), &request).unwrap();
    let run = |observe: bool| {
        let (plan, tensors) = model.record(shape, observe).unwrap();
        let mut run = model.run(plan).unwrap();
        model.write_inputs(&mut run, &tensors, shape, &images(), &request).unwrap();
        run.execute().unwrap();
        assert_eq!(run.observed().is_empty(), !observe);
        tensors.read(&run, model.architecture().sh_degree as u32).unwrap()
    };
    assert_same("observed", &bits(&run(true)), &bits(&run(false)));
}
