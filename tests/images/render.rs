//! The renderer against goldens, brute force, and itself.

use std::num::NonZeroU32;
use zipsplat::stages::render::{CameraRows, FrameInputs, FrameShape, camera_rows};
use zipsplat_tests::prelude::*;
use zipsplat_tests::{reference::render as reference, reference::render::rasterize::Rendering};

pub const ALL: RenderOptions = RenderOptions {
    rgb: true,
    alpha: true,
    depth: Some(Depth::Accumulated),
    normals: true,
    token_group: NonZeroU32::new(7),
    background: [0.0; 3],
    antialiased: Some(false),
    near: None,
};

pub fn render(scene: &Scene, cameras: &[Camera], request: &RenderOptions) -> Vec<RenderOutput> {
    Renderer::new(device()).render_scene(scene, cameras, request).unwrap()
}

pub fn bits(frames: &[RenderOutput]) -> Vec<Vec<u32>> {
    let planes = frames.iter().flat_map(|f| [&f.rgb, &f.alpha, &f.depth, &f.normals, &f.token_colors]).flatten();
    planes.map(|plane| plane.iter().map(|v| v.to_bits()).collect()).collect()
}

fn tolerances(file: &str, depth: Depth) -> [ImageTolerance; 2] {
    type T = ImageTolerance;
    match depth {
        // Stricter than `edge` antialiased: determinants as sums of squares do not cancel.
        _ if file == "raster.edge.safetensors" => [T::RGB_EDGE, T::DEPTH_EDGE],
        Depth::Accumulated => [T::RGB, T::DEPTH],
        Depth::Expected => [T::RGB, T::EXPECTED_DEPTH],
    }
}

#[test]
fn equals_the_goldens() {
    let mut renderer = Renderer::new(device());
    for file in golden::list("raster.") {
        let Some(golden) = Golden::open(&file).filter(|g| g.has("v153/classic/rgb")) else { continue };
        let (scene, cameras) = (golden_scene(&golden), golden_cameras(&golden));
        for (mode, antialiased) in [("classic", false), ("antialiased", true)] {
            for (depth, depth_key) in [(Depth::Accumulated, "D"), (Depth::Expected, "ED")] {
                let request = RenderOptions { antialiased: Some(antialiased), depth: Some(depth), ..ALL };
                let frames = renderer.render_scene(&scene, &cameras, &request).unwrap();
                let [color, z] = tolerances(&file, depth);
                let case = format!("v153/{mode}");
                compare(&golden, &case, "rgb", &frames, |f| &f.rgb, color);
                compare(&golden, &case, "alpha", &frames, |f| &f.alpha, color);
                compare(&golden, &case, depth_key, &frames, |f| &f.depth, z);
            }
        }
        let background = <[f32; 3]>::try_from(golden.f32("bg")).unwrap();
        let frames =
            renderer.render_scene(&scene, &cameras, &RenderOptions { background, ..RenderOptions::default() }).unwrap();
        let [color, _] = tolerances(&file, Depth::Accumulated);
        compare(&golden, "v153/classic", "rgb_bg", &frames, |f| &f.rgb, color);
    }
}

fn compare(
    golden: &Golden,
    case: &str,
    output: &str,
    frames: &[RenderOutput],
    plane: fn(&RenderOutput) -> &Option<Vec<f32>>,
    tolerance: ImageTolerance,
) {
    let key = format!("{case}/{output}");
    let values: Vec<f32> = frames.iter().flat_map(|f| plane(f).clone().unwrap()).collect();
    let width = frames[0].width as usize;
    let channels = values.len() / (frames.len() * width * frames[0].height as usize);
    let name = format!("{} {key}", golden.file());
    let unstable = golden.u8(&format!("{case}/unstable"));
    assert_images_close(&name, Picture { values: &values, width, channels }, &golden.f32(&key), &unstable, tolerance);
}

fn brute_force(scene: &Scene, camera: &Camera, request: &RenderOptions) -> Rendering {
    let (gaussians, camera) = (reference_gaussians(scene), reference_camera(camera));
    reference::rasterize::render(
        &gaussians,
        &camera,
        request.antialiased == Some(true),
        request.background.map(f64::from),
    )
}

#[test]
fn equals_brute_force_at_every_degree_and_shape() {
    let mut renderer = Renderer::new(device());
    // From subpixel to beyond the picture.
    for (sh_degree, size, antialiased) in [(0, 0.01, true), (1, 0.1, false), (2, 0.5, true), (3, 3.0, false)] {
        let scene = random_scene(300, sh_degree, size);
        let camera = camera(70, 53);
        let request = RenderOptions { antialiased: Some(antialiased), background: [0.2, 0.4, 0.8], ..ALL };
        let frame = renderer.render_scene(&scene, &[camera], &request).unwrap().remove(0);
        let truth = brute_force(&scene, &camera, &request);
        let hold = |what: &str, values: &Option<Vec<f32>>, expected: &[f64], tolerance| {
            let values = values.as_ref().unwrap();
            let picture = Picture { values, width: 70, channels: expected.len() / (70 * 53) };
            assert_images_close(&format!("degree {sh_degree} {what}"), picture, expected, &truth.unstable, tolerance);
        };
        hold("rgb", &frame.rgb, &truth.rgb, ImageTolerance::RGB);
        hold("alpha", &frame.alpha, &truth.alpha, ImageTolerance::RGB);
        hold("depth", &frame.depth, &truth.depth, ImageTolerance::DEPTH);
    }
}

#[test]
fn an_overflow_is_drawn_again() {
    let (scene, cameras) = (random_scene(5_000, 1, 0.2), [camera(150, 90)]);
    let enough = bits(&render(&scene, &cameras, &ALL));
    let mut tiny = Renderer::with_capacity(device(), 1);
    assert_eq!(bits(&tiny.render_scene(&scene, &cameras, &ALL).unwrap()), enough);
    let needed = tiny.intersections();
    assert!(needed < 1 << 16 && tiny.capacity() == needed + needed / 4, "{} for {needed}", tiny.capacity());
    assert_eq!(bits(&tiny.render(&cameras, &ALL).unwrap()), enough, "the second time");
}

#[test]
fn runs_give_the_same_bits() {
    let (scene, cameras) = (random_scene(20_000, 2, 0.1), [camera(200, 130), camera(130, 200)]);
    let mut renderer = Renderer::new(device());
    let first = bits(&renderer.render_scene(&scene, &cameras, &ALL).unwrap());
    for _ in 0..3 {
        assert_eq!(bits(&renderer.render(&cameras, &ALL).unwrap()), first);
    }
    assert_eq!(bits(&render(&scene, &cameras, &ALL)), first, "another renderer");
}

#[test]
fn several_cameras_are_as_each_alone() {
    let scene = random_scene(2_000, 3, 0.1);
    let moved = |mut camera: Camera, x: f64, turn: f64| {
        camera.pose = Pose { rotation: DMat3::from_rotation_y(turn), translation: DVec3::new(x, 0.1 * x, -0.2) };
        camera
    };
    let cameras = [
        moved(camera(90, 61), 0.3, 0.2),
        moved(camera(61, 90), -0.4, 0.1),
        moved(camera(90, 61), 0.0, -0.5),
        moved(camera(90, 61), 0.5, 3.0),
    ];
    let batched = render(&scene, &cameras, &ALL);
    for (camera, frame) in cameras.iter().zip(&batched) {
        assert_eq!(bits(&render(&scene, &[*camera], &ALL)), bits(std::slice::from_ref(frame)));
    }
}

#[test]
fn pictures_in_flight_are_as_each_alone() {
    let scene = random_scene(3_000, 1, 0.2);
    // More sizes than the plan cache holds.
    let cameras: Vec<Camera> = (0..23)
        .map(|i| {
            let (width, height) = if (9..12).contains(&i) { (61, 90) } else { (90, 61) };
            Camera {
                pose: Pose { translation: [0.05 * f64::from(i), 0.0, 0.0].into(), ..Pose::IDENTITY },
                ..camera(width, height)
            }
        })
        .collect();
    let expected: Vec<_> = cameras.iter().map(|camera| bits(&render(&scene, &[*camera], &ALL))).collect();
    let staged = Device::open(&DeviceOptions { force_staging: true, ..DeviceOptions::default() }).unwrap();
    for device in [device(), &staged] {
        // Every plan of one intersection overflows in flight.
        for (capacity, batch_size) in [(0, 1), (0, 8), (1, 1), (1, 8)] {
            let mut renderer = Renderer::with_capacity(device, capacity).batch_size(batch_size);
            renderer.set_scene(&scene).unwrap();
            for _ in 0..2 {
                let mut got = Vec::new();
                let gather = |index, frame| {
                    assert_eq!(index, got.len());
                    got.push(bits(&[frame]));
                    Ok(())
                };
                renderer.render_each(&cameras, &ALL, gather).unwrap();
                assert!(got == expected, "capacity {capacity}, {batch_size} together");
            }
            let (grown, default) = (renderer.capacity(), 1 << 16);
            assert!(if capacity == 1 { (2..default).contains(&grown) } else { grown == default }, "{grown}");
            assert!((2..default).contains(&renderer.intersections()), "{}", renderer.intersections());
        }
    }
}

#[test]
fn drawing_ends_where_its_pictures_are_refused() {
    let (scene, cameras) = (random_scene(500, 0, 0.2), [camera(40, 30); 40]);
    let mut renderer = Renderer::new(device());
    let expected = bits(&renderer.render_scene(&scene, &cameras[..1], &ALL).unwrap());
    let stop = |index, _| if index == 11 { Err(Error::Cancelled) } else { Ok(()) };
    assert!(matches!(renderer.render_each(&cameras, &ALL, stop), Err(Error::Cancelled)));
    assert_eq!(bits(&renderer.render_scene(&scene, &cameras[..1], &ALL).unwrap()), expected);
}

#[test]
fn pictures_of_one_pixel_row_and_column() {
    let scene = random_scene(500, 1, 0.2);
    for (width, height) in [(1, 1), (1, 8192), (8192, 1), (1, 32_768), (17, 1)] {
        let camera = camera(width, height);
        let frame = render(&scene, &[camera], &RenderOptions { depth: Some(Depth::Expected), ..ALL }).remove(0);
        assert!(frame.depth.unwrap().iter().all(|depth| depth.is_finite()), "{width}x{height}");
        let truth = brute_force(&scene, &camera, &ALL);
        let picture = Picture { values: frame.rgb.as_ref().unwrap(), width: width as usize, channels: 3 };
        let name = format!("{width}x{height}");
        assert_images_close(&name, picture, &truth.rgb, &truth.unstable, ImageTolerance::RGB_EDGE);
    }
}

#[test]
fn an_empty_scene_is_background() {
    let request = RenderOptions { background: [0.25, 0.5, 0.75], ..ALL };
    let frame = render(&Scene::default(), &[camera(5, 3)], &request).remove(0);
    assert_eq!(frame.rgb.unwrap(), [0.25, 0.5, 0.75].repeat(15));
    assert_eq!((frame.alpha.unwrap(), frame.depth.unwrap()), (vec![0.0; 15], vec![0.0; 15]));
    assert!(render(&random_scene(10, 0, 0.1), &[], &request).is_empty());
}

fn draw_within(max_binding_bytes: u64, scene: &Scene, camera: &Camera) -> Vec<u32> {
    let mut rec = Recorder::new(&Limits { max_binding_bytes, ..device().limits().clone() });
    let tensors = scenes::scene_inputs(&mut rec, scene.len(), scene.sh_degree);
    let cameras = rec.input::<CameraRows>("cameras", 1);
    let shape = FrameShape { cameras: 1, width: camera.intrinsics.width, height: camera.intrinsics.height };
    let outputs = FrameInputs { scene: &tensors, cameras, shape, options: &ALL, capacity: 1 << 14 }.record(&mut rec);
    let mut run = Run::new(device(), rec.finish().unwrap()).unwrap();
    run.write(tensors.means, &scene.means).unwrap();
    run.write(tensors.scales, &scene.scales).unwrap();
    run.write(tensors.quats, &scene.quats).unwrap();
    run.write(tensors.opacities, &scene.opacities).unwrap();
    run.write(tensors.sh_coeffs, &scene.sh_coeffs).unwrap();
    run.write(cameras, &[camera_rows(camera)]).unwrap();
    run.execute().unwrap();
    let status: Vec<u32> = run.read(outputs.status).unwrap();
    assert_eq!((status[0], status[2]), (status[1], 0), "capacity");
    run.read(outputs.frames).unwrap()
}

#[test]
fn small_bindings_cut_scenes_and_pictures() {
    let (scene, camera) = (random_scene(2_500, 3, 0.05), camera(100, 200));
    // Coefficients of 192 bytes, rows of 4,400: two parts and four bands.
    assert_eq!(draw_within(288 << 10, &scene, &camera), draw_within(128 << 20, &scene, &camera));
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let mut renderer = Renderer::new(device());
    let scene = random_scene(10, 0, 0.1);
    let nothing = RenderOptions { rgb: false, ..RenderOptions::default() };
    let refused = [
        renderer.render(&[camera(4, 4)], &ALL),
        renderer.render_scene(&scene, &[camera(4, 4)], &nothing),
        renderer.render_scene(&scene, &[camera(4, 0)], &ALL),
        renderer.render_scene(&scene, &[camera(4, 1 << 17)], &ALL),
        renderer.render_scene(&Scene { opacities: vec![2.0; 10], ..scene }, &[camera(4, 4)], &ALL),
    ];
    for result in refused {
        assert!(matches!(result, Err(Error::Argument { .. })), "{result:?}");
    }
    // Exceeds one binding.
    let everywhere = random_scene(3_000, 0, 300.0);
    match renderer.render_scene(&everywhere, &[camera(2048, 2048)], &RenderOptions::default()) {
        Err(Error::Memory { what, needed, available }) => {
            assert!(what.contains("intersections") && needed > available, "{what} {needed} {available}");
        }
        result => assert!(device().limits().max_binding_bytes > 3_000 << 16, "{result:?}"),
    }
}
