use crate::case::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use zipsplat::{gpu::Progress, kernels::ops::Add};

fn images(views: u32) -> Vec<Image> {
    (0..views).map(|view| noise(5 * 14, 4 * 14, u64::from(view))).collect()
}

fn model(device: &Device, arithmetic: Arithmetic) -> Model {
    networks::model_on(device, "micro", arithmetic)
}

fn scene(model: &Model, views: u32, ratio: f64) -> Vec<u32> {
    let options = ReconstructOptions { ratio: Ratio::Fixed(ratio), ..ReconstructOptions::default() };
    bits(&packed(&reconstruct(model, &images(views), &options).to_scene().unwrap()))
}

#[test]
fn every_run_gives_the_same_bits() {
    let elsewhere = Device::open(&DeviceOptions::default()).unwrap();
    for arithmetic in fast_arithmetics().into_iter().chain([Arithmetic::EXACT]) {
        let model_here = model(device(), arithmetic);
        let first = scene(&model_here, 2, 0.5);
        assert!(!first.is_empty());
        assert_same("again", &scene(&model_here, 2, 0.5), &first);
        let model_there = model(&elsewhere, arithmetic);
        assert_same("on another opening of the device", &scene(&model_there, 2, 0.5), &first);
    }
}

#[test]
fn staging_changes_no_bit() {
    let staged = Device::open(&DeviceOptions { force_staging: true, ..DeviceOptions::default() }).unwrap();
    let mapped = scene(&model(device(), Arithmetic::EXACT), 2, 0.5);
    assert_same("through staging memory", &scene(&model(&staged, Arithmetic::EXACT), 2, 0.5), &mapped);
}

#[test]
fn binding_parts_of_tensors_changes_no_bit() {
    // Above the largest weight, below pictures, hidden layers and head output.
    let narrow = DeviceOptions { max_binding_bytes: Some(200 << 10), ..DeviceOptions::default() };
    let narrow = Device::open(&narrow).unwrap();
    let cases = fast_arithmetics().into_iter().map(|half| (half, 1.0));
    for (arithmetic, ratio) in cases.chain([(Arithmetic::EXACT, 0.5), (Arithmetic::EXACT, 1.0)]) {
        let whole = scene(&model(device(), arithmetic), 24, ratio);
        let parts = scene(&model(&narrow, arithmetic), 24, ratio);
        assert_same(&format!("ratio {ratio}, {arithmetic:?}"), &parts, &whole);
    }
}

#[test]
fn cutting_long_dispatches_changes_no_bit() {
    // Hundreds of submissions.
    for stated in [0, 1 << 40] {
        // Above and below the fold.
        for count in [64 * 100_000 + 1, 64 * 1000] {
            // A fresh device has no measured speed.
            let device = Device::open(&DeviceOptions::default()).unwrap();
            let values = random(1, count);
            let mut rec = Recorder::new(device.limits());
            let (left, out) = (rec.input::<f32>("left", count), rec.tensor::<f32>("out", count));
            let kernel = Add { left, right: left, out, count: count as u32 };
            rec.dispatch(kernel, count).flops(stated);
            rec.output(out);
            let mut run = Run::new(&device, rec.finish().unwrap()).unwrap();
            run.write(left, &values).unwrap();
            let interrupted = catch_unwind(AssertUnwindSafe(|| run.execute_with(|_| panic!("in progress"))));
            assert!(interrupted.is_err(), "the panic passes");
            run.write(left, &values).unwrap();
            let mut submissions = 0;
            let count_submissions = |_: Progress<'_>| {
                submissions += 1;
                ControlFlow::Continue(())
            };
            run.execute_with(count_submissions).unwrap();
            assert_eq!(submissions > 1, stated > 0, "{submissions} submissions");
            let doubled: Vec<f32> = values.iter().map(|x| 2.0 * x).collect();
            assert_same(&format!("{submissions} submissions"), &run.read::<f32>(out).unwrap(), &doubled);
        }
    }
}

#[test]
fn observing_changes_no_bit() {
    let model = model(device(), Arithmetic::EXACT);
    let request = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..ReconstructOptions::default() };
    let shape = model.shape(&images(2), &request).unwrap();
    let run = |observe: bool| {
        let (plan, tensors) = model.record(shape, observe).unwrap();
        let mut run = model.run(plan).unwrap();
        model.write_inputs(&mut run, &tensors, shape, &images(2), &request).unwrap();
        run.execute().unwrap();
        assert_eq!(run.observed().is_empty(), !observe);
        tensors.read(&run).unwrap()
    };
    assert_same("observed", &bits(&packed(&run(true))), &bits(&packed(&run(false))));
}
