use crate::calls::*;
use zipsplat::types::Scene;
use zipsplat_c::{zs_status::ZS_ERROR_DEVICE_LOST, *};
use zipsplat_tests::{
    faults::{DEVICE_LOST, Faults, assert_survives},
    processes::target,
};

#[test]
fn a_lost_device_is_a_status() {
    assert_survives("lost::losing_devices");
}

#[test]
#[ignore = "child of a_lost_device_is_a_status"]
fn losing_devices() {
    if target().is_none() {
        return;
    }
    let faults = Faults::inherited();
    faults.set("none", 0, 0);
    let truth = App::default().run().expect("nothing fails");
    for function in ["vkQueueSubmit2", "vkWaitSemaphores", "vkGetSemaphoreCounterValue"] {
        faults.set(function, 0, 0);
        assert!(App::default().run() == Ok(truth.clone()), "other results after a loss");
        for call in faults.calls(4) {
            faults.set(function, call, DEVICE_LOST);
            let mut app = App::default();
            match app.run() {
                // Submissions are split by time: this run may have had fewer calls.
                Ok(found) => assert!(found == truth, "{function}, call {call}: other results, and no failure"),
                Err(status) => {
                    assert_eq!(status, ZS_ERROR_DEVICE_LOST, "{function}, call {call}: {}", message());
                    app.assert_lost(&truth);
                }
            }
        }
    }
}

#[derive(Default)]
struct App {
    device: Option<Object<zs_device>>,
    model: Option<Object<zs_model>>,
    renderer: Option<Object<zs_renderer>>,
    scene: Option<Object<zs_scene>>,
}

impl App {
    fn run(&mut self) -> Result<(Scene, Vec<u8>), zs_status> {
        let device = self.device.insert(open_device());
        let model = self.model.insert(try_model(device)?);
        let scene = self.scene.insert(reconstructed(model)?);
        let renderer = self.renderer.insert(try_renderer(device, scene)?);
        let mut pixels = Vec::new();
        for _ in 0..3 {
            pixels.extend(picture(renderer)?);
        }
        Ok((read(scene), pixels))
    }

    fn assert_lost(&self, truth: &(Scene, Vec<u8>)) {
        let device = self.device.as_ref().expect("opening a device fails nowhere");
        let lost = |what: &str, status: Option<zs_status>| {
            assert_eq!(status, Some(ZS_ERROR_DEVICE_LOST), "{what}: {}", message());
        };
        lost("loading a model", try_model(device).err());
        if let Some(model) = &self.model {
            lost("reconstructing", reconstructed(model).err());
        }
        if let Some(scene) = &self.scene {
            assert!(read(scene) == truth.0, "another scene");
            lost("making a renderer", try_renderer(device, scene).err());
            if let Some(renderer) = &self.renderer {
                lost("drawing", picture(renderer).err());
                lost("changing the scene", Some(unsafe { zs_renderer_set_scene(renderer.handle, scene.handle) }));
            }
        }
    }
}

fn reconstructed(model: &Object<zs_model>) -> Result<Object<zs_scene>, zs_status> {
    try_to_scene(&try_reconstruct(model, &[image_of(&photos(1)[0])], &reconstruct_options())?)
}

fn picture(renderer: &Object<zs_renderer>) -> Result<Vec<u8>, zs_status> {
    try_draw(renderer, &camera(32, 32, 0.0), &render_options(zs_pixel_format::ZS_PIXEL_RGBA8), 4)
}
