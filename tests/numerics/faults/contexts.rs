use crate::{micro, noise};
use zipsplat::Result;
use zipsplat_tests::faults::{DEVICE_LOST, Faults, OUT_OF_HOST_MEMORY, assert_survives};
use zipsplat_tests::prelude::*;

#[test]
fn a_lost_device_stays_lost_and_another_works() {
    assert_survives("faults::contexts::losing_devices");
}

/// Also with staged transfers, as on discrete GPUs.
#[test]
#[ignore = "child of a_lost_device_stays_lost_and_another_works"]
fn losing_devices() {
    if target().is_none() {
        return;
    }
    for staged in [false, true] {
        let work = Work::new(staged);
        let mut functions = vec!["vkQueueSubmit2", "vkWaitSemaphores", "vkGetSemaphoreCounterValue"];
        functions.extend(staged.then_some("vkWaitForFences"));
        for function in functions {
            for call in work.calls(function) {
                let Some(error) = work.fails(function, call, DEVICE_LOST, true) else { continue };
                assert!(matches!(error, Error::DeviceLost), "{function}, call {call}: {error}");
            }
        }
        // A rejected submission is not waited for.
        let refusals =
            ["vkQueueSubmit2", "vkCreateFence", "vkCreateCommandPool", "vkAllocateMemory", "vkBeginCommandBuffer"];
        for function in refusals.into_iter().filter(|function| staged || *function != "vkCreateFence") {
            for call in work.calls(function) {
                let Some(error) = work.fails(function, call, OUT_OF_HOST_MEMORY, false) else { continue };
                assert!(
                    matches!(error, Error::Driver { .. } | Error::Memory { .. }),
                    "{function}, call {call}: {error}"
                );
            }
        }
    }
}

struct Work {
    faults: Faults,
    options: DeviceOptions,
    images: [Image; 2],
    scene: Scene,
    truth: (Scene, Vec<RenderOutput>),
}

#[derive(Default)]
struct Made {
    model: Option<Model>,
    renderer: Option<Renderer>,
    pictures: Vec<RenderOutput>,
    scene: Option<Scene>,
}

impl Work {
    fn new(staged: bool) -> Self {
        let options = DeviceOptions { force_staging: staged, ..DeviceOptions::default() };
        let images = [noise(28, 28, 1), noise(28, 28, 2)];
        let scene = random_scene(100, 0, 0.1);
        let mut work = Self { faults: Faults::inherited(), options, images, scene, truth: Default::default() };
        work.faults.set("none", 0, 0);
        work.truth = work.sound();
        work
    }

    fn open(&self) -> Device {
        Device::open(&self.options).expect("opening a device fails nowhere")
    }

    fn run(&self, device: &Device, made: &mut Made) -> Result<()> {
        let model = made.model.insert(Model::from_checkpoint(device, &micro(), |_| ControlFlow::Continue(()))?);
        made.scene = Some(
            model
                .reconstruct_views(&self.images, &ReconstructOptions::default(), |_| ControlFlow::Continue(()))?
                .to_scene()?,
        );
        let renderer = made.renderer.insert(Renderer::new(device));
        renderer.set_scene(&self.scene)?;
        renderer.render_each(&[camera(20, 20); 4], &RenderOptions::default(), |_, frame| {
            made.pictures.push(frame);
            Ok(())
        })
    }

    fn sound(&self) -> (Scene, Vec<RenderOutput>) {
        let mut made = Made::default();
        self.run(&self.open(), &mut made).unwrap_or_else(|error| panic!("on a sound device: {error}"));
        (made.scene.expect("a scene"), made.pictures)
    }

    fn calls(&self, function: &str) -> Vec<u32> {
        self.faults.set(function, 0, 0);
        assert!(self.sound() == self.truth, "other results after failures");
        self.faults.calls(3)
    }

    /// With `lost`, the device stays lost. `None` if this run had fewer calls.
    fn fails(&self, function: &str, call: u32, result: i32, lost: bool) -> Option<Error> {
        self.faults.set(function, call, result);
        let (device, mut made) = (self.open(), Made::default());
        let Err(error) = self.run(&device, &mut made) else {
            drop((made, device));
            assert!(self.faults.made() < call, "{function}, call {call}: nobody was told");
            return None;
        };
        if lost {
            let context = format!("after {function}, call {call}");
            self.assert_lost(&device, &mut made, &context);
        }
        Some(error)
    }

    fn assert_lost(&self, device: &Device, made: &mut Made, context: &str) {
        let lost = |name: &str, result: Result<()>| match result {
            Err(Error::DeviceLost) => {}
            other => panic!("{context}, {name}: {other:?}"),
        };
        lost("loading a model", Model::from_checkpoint(device, &micro(), |_| ControlFlow::Continue(())).map(drop));
        lost("loading a scene", Renderer::new(device).set_scene(&self.scene));
        if let Some(model) = &made.model {
            let again =
                model.reconstruct_views(&self.images, &ReconstructOptions::default(), |_| ControlFlow::Continue(()));
            lost("reconstructing", again.map(drop));
        }
        if let Some(renderer) = &mut made.renderer {
            lost("loading the same scene", renderer.set_scene(&self.scene));
            let drawn = renderer.render(&[camera(20, 20)], &RenderOptions::default());
            assert!(matches!(drawn, Err(Error::DeviceLost | Error::Argument { .. })), "{context}, drawing: {drawn:?}");
        }
        assert!(made.pictures.iter().all(|frame| *frame == self.truth.1[0]), "{context}: a picture of a lost device");
    }
}
