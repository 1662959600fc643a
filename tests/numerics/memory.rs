//! Just enough memory, and one byte less.

use crate::{doctor::zipsplat, micro, noise};
use zipsplat::types::write_ply;
use zipsplat_tests::prelude::*;

#[test]
fn a_plan_runs_in_its_peak_and_is_refused_below() {
    let images = [noise(70, 56, 1), noise(70, 56, 2)];
    let request = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..ReconstructOptions::default() };
    let open = |bytes, staged| {
        let options =
            DeviceOptions { max_memory_bytes: Some(bytes), force_staging: staged, ..DeviceOptions::default() };
        Device::open(&options).unwrap()
    };
    let load = |device: &Device| Model::from_checkpoint(device, &micro(), |_| ControlFlow::Continue(()));
    // As on discrete GPUs.
    for staged in [false, true] {
        let device = open(u64::MAX, staged);
        let model = load(&device).unwrap();
        let planned = model.plan(model.shape(&images, &request).unwrap()).unwrap();
        let (arena, weights, scene) = (planned.plan.arena_bytes(), model.weight_bytes(), planned.layout.bytes());
        let exact = model.reconstruct_views(&images, &request, |_| ControlFlow::Continue(())).unwrap();
        assert_eq!(exact.peak_bytes, arena + weights + scene);
        assert_eq!(exact.peak_bytes, device.allocated_bytes());

        let model = load(&open(exact.peak_bytes, staged)).unwrap();
        let again = model.reconstruct_views(&images, &request, |_| ControlFlow::Continue(())).unwrap();
        assert!(
            again.to_scene().unwrap() == exact.to_scene().unwrap(),
            "another scene in no more memory than it takes"
        );

        let model = load(&open(exact.peak_bytes - 1, staged)).unwrap();
        let begun = |_: zipsplat::gpu::Progress<'_>| panic!("something was submitted");
        let error = model.reconstruct_views(&images, &request, begun).unwrap_err();
        let Error::Memory { needed, available, .. } = error else { panic!("{error}") };
        assert_eq!((needed, available), (arena, arena - 1));

        let error = load(&open(weights - 1, staged)).map(drop).unwrap_err();
        let Error::Memory { needed, available, .. } = error else { panic!("{error}") };
        assert_eq!((needed, available), (weights, weights - 1));
    }
}

#[test]
fn a_picture_needs_no_more_memory_after_others() {
    let (scene, smaller) = (random_scene(60_000, 1, 0.01), random_scene(50_000, 1, 0.01));
    let draw = |renderer: &mut Renderer, scene, side| {
        renderer.render_scene(scene, &[camera(side, side)], &RenderOptions::default())
    };
    let renderer = |bytes| {
        let options = DeviceOptions { max_memory_bytes: Some(bytes), ..DeviceOptions::default() };
        Renderer::new(&Device::open(&options).unwrap())
    };
    let mut bytes = 0;
    let alone = loop {
        match draw(&mut renderer(bytes), &scene, 256) {
            Err(Error::Memory { needed, available, .. }) => bytes += needed - available,
            drawn => break drawn.unwrap(),
        }
    };
    let mut renderer = renderer(bytes);
    for (before, side) in [(&smaller, 128), (&scene, 128), (&scene, 64)] {
        draw(&mut renderer, before, side).unwrap();
        assert!(draw(&mut renderer, &scene, 256).unwrap() == alone, "after {} at {side}", before.len());
    }
}

/// Adds the shortage in its errors.
fn least_memory(line: &str, output: &Path) -> u64 {
    let mut memory = 0;
    for _ in 0..8 {
        let (code, out, err) = zipsplat(&format!("{line} --max-memory {memory}"));
        if code == 0 {
            return memory;
        }
        assert_eq!((code, out.as_str(), output.exists()), (4, "", false), "{err}");
        let number = |before: &str| {
            let word = err.split(before).next()?.split_whitespace().last()?;
            word.parse::<u64>().ok()
        };
        let numbers = number(" bytes, ").zip(number(" bytes are there"));
        let (needed, available) = numbers.unwrap_or_else(|| panic!("without bytes: {err}"));
        assert!(needed > available && available <= memory, "{err}");
        memory += needed - available;
    }
    panic!("{line}: {memory} bytes are not enough, though errors said so");
}

#[test]
fn commands_say_how_much_memory_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("photos")).unwrap();
    noise(40, 30, 1).save_png(at("photos/1.png")).unwrap();
    micro().save(at("micro.safetensors"), Dtype::F32).unwrap();
    write_ply(&random_scene(500, 1, 0.1), at("scene.ply")).unwrap();
    let lines = [
        ("reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/out.ply", "out.ply"),
        ("render @/scene.ply --wiggle --frames 5 --size 90x60 -o @/out", "out"),
    ];
    for (line, output) in lines {
        let line = line.replace('@', &folder.path().display().to_string());
        let least = least_memory(&line, &at(output));
        assert!(at(output).exists());
        let (code, _, err) = zipsplat(&format!("{line} --max-memory {}", least - 1));
        assert!(code == 4 && err.contains("bytes are there"), "{code} {err}");
        let (code, _, err) = zipsplat(&format!("{line} --max-memory 16000000G"));
        assert_eq!(code, 0, "{err}");
    }
    for wrong in ["1T", "-1", "K", "99999999999G", ""] {
        assert_eq!(zipsplat(&format!("doctor list --max-memory={wrong}")).0, 2, "{wrong}");
    }
    assert!(
        zipsplat(&format!("render {}/scene.ply --wiggle --max-memory 1K -o {0}/none", folder.path().display())).0 == 4
    );
}
