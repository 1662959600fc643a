use super::*;
use std::borrow::Cow;
use std::sync::atomic::{AtomicUsize, Ordering};
use zipsplat::refine::{Photos, RefineCheckpoint};

struct Opened<'a>(&'a [Image], &'a AtomicUsize);

impl Photos for Opened<'_> {
    fn count(&self) -> usize {
        self.0.len()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        self.0.size(i)
    }

    fn open(&self, i: usize) -> zipsplat::Result<Cow<'_, Image>> {
        let left = self.1.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
        left.map_err(|_| zipsplat::Error::argument(format!("photo {i}"), "no file", "a file"))?;
        Ok(Cow::Borrowed(&self.0[i]))
    }
}

/// Takes 20 steps, with one thread for photos; also returns the times left.
fn refine_opened(photos: &[Image], times: usize, max_photo_bytes: u64) -> (RefineResult, usize) {
    refine_from(photos, times, max_photo_bytes, None)
}

fn refine_from(
    photos: &[Image],
    times: usize,
    max_photo_bytes: u64,
    checkpoint: Option<RefineCheckpoint>,
) -> (RefineResult, usize) {
    let cameras = cameras(photos.len());
    let request = RefineOptions {
        length: RefineLength::Steps(20),
        holdout_views: Some(1),
        views_per_step: 2,
        max_photo_bytes,
        checkpoint,
        ..RefineOptions::default()
    };
    let (left, arena, scene) = (AtomicUsize::new(times), Arena::new(device()), moved(&random_scene(80, 1, 0.3)));
    let thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let never = |_: RefineProgress<'_>| ControlFlow::Continue(());
    let opened = Opened(photos, &left);
    let refined = thread.install(|| refine_scene(&arena, &scene, opened, &cameras, &request, never)).unwrap();
    (refined, left.into_inner())
}

#[test]
fn results_are_independent_of_the_memory_for_photos() {
    let photos = photos(&cameras(6)).1;
    let (kept, left) = refine_opened(&photos, 500, u64::MAX);
    assert_eq!((kept.stop_reason, kept.losses.len(), left), (None, 20, 494));
    // Three of six photos fit 20,000 bytes.
    let mut before = (left, kept.photo_bytes);
    for max_photo_bytes in [20_000, 0] {
        let (opened, left) = refine_opened(&photos, 500, max_photo_bytes);
        assert!(opened.scene == kept.scene && opened.losses == kept.losses, "{max_photo_bytes}");
        let now = (left, opened.photo_bytes);
        assert!(now.0 < before.0 && now.1 < before.1 && now.1 <= max_photo_bytes, "{max_photo_bytes}: {now:?}");
        before = now;
    }
}

#[test]
fn photos_that_vanish_end_the_refinement_with_the_best_scene_and_a_checkpoint() {
    let (photos, folder) = (photos(&cameras(6)).1, tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let checkpoint = RefineCheckpoint { path: path.clone(), interval: Duration::MAX, photos: "these".into() };
    let (refined, _) = refine_from(&photos, 12, 0, Some(checkpoint.clone()));
    assert!(matches!(&refined.stop_reason, Some(StopReason::Failed(why)) if why.contains("no file")));
    let steps = refined.losses.len();
    assert!((1..20).contains(&steps) && (1..=steps).contains(&refined.best_step), "{steps}, {}", refined.best_step);
    let (resumed, _) = refine_from(&photos, 500, 0, Some(checkpoint));
    let (whole, _) = refine_opened(&photos, 500, 0);
    assert_eq!((resumed.resumed_step, resumed.stop_reason), (steps, None));
    assert!(resumed.scene == whole.scene && resumed.losses == whole.losses && path.exists());
}

#[test]
fn small_photos_that_are_held_out_do_not_change_the_sizes_of_others() {
    let cameras = [camera(256, 200), camera(48, 36), camera(256, 200)];
    let (scene, photos) = photos(&cameras);
    let request = RefineOptions {
        length: RefineLength::Steps(4),
        holdout_views: Some(1),
        max_gaussians: Some(0),
        ..RefineOptions::default()
    };
    let refined = refine(&moved(&scene), &photos, &cameras, &request);
    assert_eq!((refined.holdout_views, refined.sizes), (vec![1], vec![(0, [128, 100]), (2, [256, 200])]));
}

/// Their own photos would otherwise differ.
#[test]
fn antialiased_scenes_are_refined_as_such() {
    let cameras = cameras(2);
    let scene = Scene { antialiased: true, ..random_scene(200, 0, 0.02) };
    let options = RefineOptions { length: RefineLength::Steps(1), ..RefineOptions::default() };
    let refined = refine(&scene, &photos_of(&scene, &cameras), &cameras, &options);
    assert!(refined.scene.antialiased && refined.training_psnr[1] > 50.0, "{:?}", refined.training_psnr);
    let plain = Scene { antialiased: false, ..scene.clone() };
    let other = refine(&plain, &photos_of(&scene, &cameras), &cameras, &options);
    assert!(!other.scene.antialiased && other.training_psnr[1] < 40.0, "{:?}", other.training_psnr);
}
