//! Steps that do not fit the device.

use super::*;
use zipsplat::{
    gpu::{Resident, ResidentLayout},
    refine::RefineCheckpoint,
};

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

#[test]
fn photos_of_a_step_that_does_not_fit_are_used_after_a_restart() {
    let cameras: Vec<Camera> = cameras(12).into_iter().step_by(2).collect();
    let (scene, mut photos) = photos(&cameras);
    // Steps with a mask need the most memory.
    photos[3].mask = Some(vec![255; 48 * 36]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let options = RefineOptions {
        length: RefineLength::Steps(8),
        views_per_step: 2,
        batch_size: Some(1),
        max_gaussians: Some(0),
        checkpoint: Some(RefineCheckpoint { path, interval: Duration::MAX, photos: "these".into() }),
        ..RefineOptions::default()
    };
    let (start, device) = (moved(&scene), open(64 << 20));
    let mut rest = None;
    let progress = |_: RefineProgress<'_>| {
        rest.get_or_insert_with(|| {
            let mut layout = ResidentLayout::new(device.limits());
            layout.add::<[u8; 256]>((device.limits().memory_bytes - device.allocated_bytes()) as usize / 256);
            Resident::new(&device, &layout).unwrap()
        });
        ControlFlow::Continue(())
    };
    let failed = refine_scene(&Arena::new(&device), &start, &photos, &cameras, &options, progress).unwrap();
    let why = failed.stop_reason;
    assert!(matches!(&why, Some(StopReason::Failed(why)) if why.contains("bytes are there")), "{why:?}");
    let steps = failed.losses.len();
    assert!((1..8).contains(&steps), "{steps}");
    let resumed = refine(&start, &photos, &cameras, &options);
    let whole = refine(&start, &photos, &cameras, &RefineOptions { checkpoint: None, ..options });
    assert_eq!((resumed.resumed_step, &resumed.losses), (steps, &whole.losses));
    assert!(resumed.scene == whole.scene);
}
