//! Steps that do not fit the device.

use super::*;

fn open(max_memory_bytes: u64) -> Device {
    let options = DeviceOptions { max_memory_bytes: Some(max_memory_bytes), ..DeviceOptions::default() };
    Device::open(&options).unwrap()
}

#[test]
fn a_last_phase_that_does_not_fit_fails_before_the_first_step() {
    let cameras = [camera(200, 192)];
    let (scene, photos) = photos(&cameras);
    let options = RefineOptions { length: RefineLength::Steps(4), max_gaussians: Some(0), ..RefineOptions::default() };
    let start = moved(&scene);
    let within = |bytes: u64, progress: fn(RefineProgress<'_>) -> ControlFlow<()>| {
        refine_scene(&Arena::new(&open(bytes)), &start, &photos, &cameras, &options, progress)
    };
    let whole = within(u64::MAX, |_| ControlFlow::Continue(())).unwrap();
    assert_eq!(whole.sizes, [(0, [100, 96]), (2, [200, 192])]);
    let again = within(whole.peak_bytes, |_| ControlFlow::Continue(())).unwrap();
    assert!(again.scene == whole.scene && again.stop_reason.is_none());
    let error = within(whole.peak_bytes - 1, |_| panic!("a step")).unwrap_err();
    assert!(matches!(error, Error::Memory { .. }), "{error}");
}
