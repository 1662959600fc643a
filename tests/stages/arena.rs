use zipsplat::{gpu::Arena, stages::render::plan_pictures};
use zipsplat_tests::prelude::*;

/// An own device, to count its memory.
fn alone(staged: bool) -> (Device, Model) {
    let device = Device::open(&DeviceOptions { force_staging: staged, ..DeviceOptions::default() }).unwrap();
    let model = networks::model_on(&device, "micro", Arithmetic::EXACT);
    (device, model)
}

fn photos(count: usize) -> Vec<Image> {
    (0..count as u64).map(|i| noise(56, 42, i)).collect()
}

fn cameras() -> Vec<Camera> {
    let at = |x: f64| {
        let mut camera = camera(56, 42);
        camera.pose.translation.x += x;
        camera
    };
    (0..16).map(|i| at(0.02 * f64::from(i))).collect()
}

fn pictures(renderer: &mut Renderer) -> Vec<RenderOutput> {
    let mut frames = Vec::new();
    let push = |_, frame| {
        frames.push(frame);
        Ok(())
    };
    renderer.render_each(&cameras(), &RenderOptions::default(), push).unwrap();
    frames
}

#[test]
fn a_scene_of_kept_features_is_that_of_the_photos() {
    let (_, model) = alone(false);
    let photos = photos(3);
    let features = model.features(&photos, &ReconstructOptions::default(), |_| ControlFlow::Continue(())).unwrap();
    for (ratio, selection) in [
        (1.0, TokenSelection::KMEANS),
        (0.5, TokenSelection::KMEANS),
        (0.25, TokenSelection::Stride),
        (0.25, TokenSelection::MutualNearest),
        (0.3, TokenSelection::Random(4)),
    ] {
        let ratio = Ratio::Fixed(ratio);
        let request = ReconstructOptions { ratio, token_selection: selection, ..ReconstructOptions::default() };
        let kept = model.reconstruct_features(&features, &request, |_| ControlFlow::Continue(())).unwrap();
        let whole = reconstruct(&model, &photos, &request);
        assert!(kept.to_scene().unwrap() == whole.to_scene().unwrap(), "{request:?}");
        assert_eq!((kept.tokens, &kept.patches), (whole.tokens, &whole.patches));
        let index = |token: usize| {
            let (view, at) = kept.patches.patch(token);
            12 * view as u32 + 4 * (at.y as u32 / 14) + at.x as u32 / 14
        };
        let indices: Vec<u32> = (0..kept.tokens).map(index).collect();
        assert_eq!(indices, kept.patches.indices());
        let token_selection = TokenSelection::Given(indices);
        let given = ReconstructOptions { token_selection, ..ReconstructOptions::default() };
        let again = model.reconstruct_features(&features, &given, |_| ControlFlow::Continue(())).unwrap();
        assert!(again.to_scene().unwrap() == kept.to_scene().unwrap(), "{request:?}");
        assert!(kept.times.0.iter().all(|(stage, _)| stage != "backbone"), "{:?}", kept.times);
    }
}

#[test]
fn a_second_reconstruction_takes_no_memory() {
    for staged in [false, true] {
        let (device, model) = alone(staged);
        let (photos, request) = (photos(2), ReconstructOptions::default());
        let first = reconstruct(&model, &photos, &request);
        let (bytes, scene) = (device.allocated_bytes(), first.to_scene().unwrap());
        assert_eq!(bytes, first.peak_bytes);
        drop(first);
        for _ in 0..3 {
            let again = reconstruct(&model, &photos, &request);
            assert!(again.to_scene().unwrap() == scene);
            assert_eq!(device.allocated_bytes(), bytes);
        }
    }
}

#[test]
fn a_scene_that_somebody_has_stays_as_it_is() {
    let (device, model) = alone(false);
    let request = ReconstructOptions::default();
    let (few, other) = (photos(2), photos(4)[2..].to_vec());
    let first = reconstruct(&model, &few, &request);
    let (before, bytes) = (first.to_scene().unwrap(), device.allocated_bytes());
    let second = reconstruct(&model, &other, &request);
    assert!(second.to_scene().unwrap() != before && first.to_scene().unwrap() == before);
    assert_eq!(device.allocated_bytes(), bytes + first.gaussians.bytes());
    let mut renderer = Renderer::new(&device);
    renderer.set_scene(&first.gaussians).unwrap();
    let drawn = pictures(&mut renderer);
    drop(first);
    let most = device.allocated_bytes();
    let third = reconstruct(&model, &other, &request);
    assert!(pictures(&mut renderer) == drawn, "what is shown was overwritten");
    assert!(third.to_scene().unwrap() == second.to_scene().unwrap());
    assert_eq!(device.allocated_bytes(), most + third.gaussians.bytes());
}

#[test]
fn pictures_are_drawn_from_the_devices_own_gaussians_in_the_networks_arena() {
    for staged in [false, true] {
        let (device, model) = alone(staged);
        let request = ReconstructOptions { scene_scale: Some(0.5), ..ReconstructOptions::default() };
        let made = reconstruct(&model, &photos(2), &request);
        let mut renderer = Renderer::new(&device);
        renderer.set_scene(&made.gaussians).unwrap();
        let own = pictures(&mut renderer);
        assert!(own.iter().any(|frame| frame.rgb.as_ref().unwrap().iter().any(|value| *value > 0.0)));

        let shape = model.shape(&photos(2), &request).unwrap();
        let planned = model.plan(shape).unwrap();
        let drawing =
            plan_pictures(device.limits(), made.gaussians.tensors(), [56, 42], &RenderOptions::default()).unwrap();
        let lanes = Arena::lane_bytes([&planned.plan, &drawing]) + drawing.arena_bytes();
        assert_eq!(device.allocated_bytes(), model.weight_bytes() + planned.layout.bytes() + lanes);

        let scene: Scene = made.to_scene().unwrap();
        let mut other = Renderer::new(&device);
        other.set_scene(&scene).unwrap();
        assert!(pictures(&mut other) == own, "another road, other bits");
        assert!(reconstruct(&model, &photos(2), &request).to_scene().unwrap() == scene);
        assert!(pictures(&mut renderer) == own);
    }
}

#[test]
fn who_finds_the_arena_in_use_takes_another() {
    let (device, model) = alone(false);
    let (photos, request) = (photos(2), ReconstructOptions::default());
    let first = reconstruct(&model, &photos, &request);
    let scene = first.to_scene().unwrap();
    let mut renderer = Renderer::new(&device);
    renderer.set_scene(&first.gaussians).unwrap();
    let drawn = pictures(&mut renderer);

    // From a progress callback.
    let mut inner = Vec::new();
    let outer = model
        .reconstruct_views(&photos, &request, |_| {
            if inner.is_empty() {
                inner.push(reconstruct(&model, &photos, &request).to_scene().unwrap());
                assert!(pictures(&mut renderer) == drawn);
            }
            ControlFlow::Continue(())
        })
        .unwrap();
    assert!(inner[0] == scene && outer.to_scene().unwrap() == scene);

    // While pictures are in flight.
    renderer.set_scene(&first.gaussians).unwrap();
    let mut frames = Vec::new();
    let push = |_, frame| {
        assert!(reconstruct(&model, &photos, &request).to_scene().unwrap() == scene);
        frames.push(frame);
        Ok(())
    };
    renderer.render_each(&cameras(), &RenderOptions::default(), push).unwrap();
    assert!(frames == drawn);
}

#[test]
fn memory_of_pictures_is_freed_for_every_pass() {
    let (photos, request) = (photos(2), ReconstructOptions::default());
    let mut max_memory_bytes = None;
    for is_limited in [false, true] {
        let device = Device::open(&DeviceOptions { max_memory_bytes, ..DeviceOptions::default() }).unwrap();
        let model = networks::model_on(&device, "micro", Arithmetic::EXACT);
        let made = reconstruct(&model, &photos, &request);
        let features = || model.features(&photos, &request, |_| ControlFlow::Continue(())).unwrap();
        let kept = features();
        let mut renderer = Renderer::new(&device);
        renderer.set_scene(&made.gaussians).unwrap();
        let mut draw = || renderer.render_each(&[camera(900, 700)], &RenderOptions::default(), |_, _| Ok(())).unwrap();
        draw();
        max_memory_bytes = Some(device.allocated_bytes());
        if is_limited {
            drop(features());
            draw();
            drop(model.tokens(&kept, &request, |_| ControlFlow::Continue(())).unwrap());
            draw();
            drop(model.reconstruct_features(&kept, &request, |_| ControlFlow::Continue(())).unwrap());
            draw();
            assert!(reconstruct(&model, &photos, &request).to_scene().unwrap() == made.to_scene().unwrap());
        }
    }
}

#[test]
fn a_scene_of_another_device_is_refused() {
    let (_, model) = alone(false);
    let (other, _) = alone(false);
    let made = reconstruct(&model, &photos(1), &ReconstructOptions::default());
    assert_refused(Renderer::new(&other).set_scene(&made.gaussians), &["another device"]);
}
