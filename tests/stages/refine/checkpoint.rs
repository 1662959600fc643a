use super::*;
use std::path::Path;
use zipsplat::{
    ops::Arithmetic,
    reconstruct::ReconstructOptions,
    refine::{Exposure, FrozenHead, RefineCheckpoint, refine_tokens},
    weights::Checkpoint,
};
use zipsplat_tests::{
    architectures, networks,
    photos::noise,
    processes::{child, target},
};

const STEPS: usize = 24;

fn options(path: &Path) -> RefineOptions {
    RefineOptions {
        length: RefineLength::Steps(STEPS),
        holdout_views: Some(1),
        exposure: Exposure::On,
        optimize_cameras: true,
        max_gaussians: Some(120),
        checkpoint: Some(RefineCheckpoint { path: path.to_owned(), interval: Duration::ZERO, photos: "these".into() }),
        ..RefineOptions::default()
    }
}

fn same(a: &RefineResult, b: &RefineResult) -> bool {
    let of =
        |r: &RefineResult| (r.losses.clone(), r.holdout_psnr.clone(), r.sizes.clone(), r.best_step, r.training_psnr);
    a.scene == b.scene && a.cameras == b.cameras && a.exposures == b.exposures && of(a) == of(b)
}

fn assert_continues(scene: &Scene, photos: &[Image], cameras: &[Camera], request: &RefineOptions, ends: [usize; 2]) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let until = |end: usize, checkpoint: Option<RefineCheckpoint>| {
        let progress = |now: RefineProgress<'_>| {
            if now.step == end { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let options = RefineOptions { checkpoint, ..request.clone() };
        refine_scene(&Arena::new(device()), scene, photos, cameras, &options, progress).unwrap()
    };
    let whole = until(usize::MAX, None);
    for end in ends {
        until(end, options(&path).checkpoint);
        let finished = until(usize::MAX, options(&path).checkpoint);
        assert!(same(&finished, &whole) && finished.resumed_step == end, "after step {end}");
        std::fs::remove_file(&path).unwrap();
    }
}

#[test]
fn floaters_are_cleared_alike_when_continued() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    assert_continues(&moved(&scene), &white(&photos), &cameras, &with_large_steps_of_scales(), [2, 4]);
}

#[test]
fn many_uses_of_photos_hide_gaussians_alike_when_continued() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    let request = |steps| RefineOptions { length: RefineLength::Steps(steps), ..sixty_steps_at_full_size() };
    assert_continues(&moved(&scene), &photos, &cameras, &request(150), [1, 149]);
    let [few, many] = [100, 150].map(|steps| refine(&scene, &photos, &cameras, &request(steps)).losses[0]);
    assert!(2.0 * few < many, "{few} {many}");
}

#[test]
fn every_step_can_be_continued_bit_by_bit() {
    let (cameras, photos, moved) = place();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let until = |end: usize, options: &RefineOptions| {
        let progress = |now: RefineProgress<'_>| {
            if now.step == end { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        refine_scene(&Arena::new(device()), &moved, &photos, &cameras, options, progress)
    };
    let whole = until(usize::MAX, &RefineOptions { checkpoint: None, ..options(&path) }).unwrap();
    assert!(whole.exposures.is_some() && whole.scene.len() > moved.len() && whole.cameras != cameras);
    for end in 1..STEPS {
        let ended = until(end, &options(&path)).unwrap();
        assert_eq!((ended.losses.len(), ended.stop_reason), (end, Some(StopReason::Cancelled)));
        if end % 3 == 0 {
            until(end + 1, &options(&path)).unwrap();
        }
        let finished = until(usize::MAX, &options(&path)).unwrap();
        assert!(same(&finished, &whole) && finished.resumed_step >= end, "after step {end}");
        assert_eq!(names(folder.path()), ["checkpoint.safetensors"]);
        std::fs::remove_file(&path).unwrap();
    }

    until(5, &options(&path)).unwrap();
    let saved = std::fs::read(&path).unwrap();
    let refused = |options: &RefineOptions, words: &[&str]| {
        let error = until(usize::MAX, options).map(drop).unwrap_err().to_string();
        let words = [words, &["checkpoint.safetensors", "delete"]].concat();
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
    };
    refused(&RefineOptions { seed: 1, ..options(&path) }, &["another refinement", "options"]);
    let mut others = options(&path);
    others.checkpoint.as_mut().unwrap().photos = "others".into();
    refused(&others, &["another refinement", "photos"]);
    for len in [0, 7, 200, saved.len() / 2, saved.len() - 1] {
        std::fs::write(&path, &saved[..len]).unwrap();
        refused(&options(&path), &["truncated"]);
        assert_eq!(std::fs::read(&path).unwrap(), &saved[..len], "nothing is lost");
    }
    let version = b"3 of zipsplat";
    let at = saved.windows(version.len()).position(|bytes| bytes == version).unwrap();
    let older = [&saved[..at], b"0", &saved[at + 1..]].concat();
    std::fs::write(&path, older).unwrap();
    refused(&options(&path), &["version", "0 of zipsplat", "3 of zipsplat"]);
    std::fs::write(&path, &saved).unwrap();
    assert!(same(&until(usize::MAX, &options(&path)).unwrap(), &whole));
}

fn place() -> (Vec<Camera>, Vec<Image>, Scene) {
    let cameras = cameras(7);
    let (scene, photos) = photos(&cameras);
    (cameras, photos, moved(&scene))
}

#[test]
#[ignore = "run in a process of its own"]
fn refines_until_killed() {
    let Some(folder) = target() else { return };
    let (cameras, photos, moved) = place();
    let options = RefineOptions { length: RefineLength::Steps(200), ..options(&folder.join("checkpoint.safetensors")) };
    refine(&moved, &photos, &cameras, &options);
}

#[test]
fn killed_refinements_continue_bit_by_bit() {
    let (cameras, photos, moved) = place();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let options = RefineOptions { length: RefineLength::Steps(200), ..options(&path) };
    let whole = refine(&moved, &photos, &cameras, &RefineOptions { checkpoint: None, ..options.clone() });
    let changed = |path: &Path| path.metadata().and_then(|found| found.modified()).ok();
    for milliseconds in [1, 23, 57] {
        let before = changed(&path);
        let mut killed = child("refine::checkpoint::refines_until_killed", folder.path(), "").spawn().unwrap();
        while changed(&path) == before {
            assert!(killed.try_wait().unwrap().is_none(), "it ended by itself");
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(milliseconds));
        killed.kill().unwrap();
        killed.wait().unwrap();
    }
    let finished = refine(&moved, &photos, &cameras, &options);
    println!("killed before step {}", finished.resumed_step);
    assert!(same(&finished, &whole) && (1..200).contains(&finished.resumed_step));
    assert_eq!(names(folder.path()), ["checkpoint.safetensors"], "no temporary file is left");
}

fn names(folder: &Path) -> Vec<String> {
    std::fs::read_dir(folder).unwrap().map(|file| file.unwrap().file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn tokens_and_times_can_be_continued() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let model = networks::model("micro", Arithmetic::EXACT);
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").unwrap();
    let images: Vec<Image> = (0..3).map(|i| noise(28, 28, i)).collect();
    let request = ReconstructOptions::default();
    let features = model.features(&images, &request, |_| ControlFlow::Continue(())).unwrap();
    let tokens = model.tokens(&features, &request, |_| ControlFlow::Continue(())).unwrap();
    let head = FrozenHead::load(device(), &checkpoint).unwrap();
    let cameras: Vec<Camera> = (0..3)
        .map(|i| {
            let mut camera = camera(28, 28);
            camera.pose.translation.x += 0.05 * f64::from(i);
            camera
        })
        .collect();
    let options = RefineOptions { max_gaussians: None, holdout_views: Some(0), ..options(&path) };
    let until = |end: usize, options: &RefineOptions| {
        let progress = |now: RefineProgress<'_>| {
            if now.step == end { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        refine_tokens(&Arena::new(device()), &head, &tokens, &images, &cameras, options, progress).unwrap()
    };
    let whole = until(usize::MAX, &RefineOptions { checkpoint: None, ..options.clone() });
    for end in [1, 10, STEPS - 1] {
        until(end, &options);
        assert!(same(&until(usize::MAX, &options), &whole), "after step {end}");
        std::fs::remove_file(&path).unwrap();
    }
    // A time becomes steps once.
    let timed = RefineOptions { length: RefineLength::Time(Duration::from_millis(300)), ..options };
    let ended = until(1, &timed);
    let finished = until(usize::MAX, &timed);
    assert_eq!(
        (finished.steps, finished.losses.len(), &finished.losses[..1]),
        (ended.steps, ended.steps, &ended.losses[..])
    );
}
