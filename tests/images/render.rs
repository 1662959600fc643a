//! The renderer against the goldens, against brute force, and against itself.

use zipsplat::{
    Error,
    gpu::{Device, DeviceOptions},
    stages::render::{Depth, Frame, RenderRequest, Renderer},
    types::{Camera, Scene},
};
use zipsplat_tests::{
    compare::{ImageTolerance, Picture, assert_images_close},
    golden::{self, Golden},
    scenes::{camera, golden_cameras, golden_scene, random_scene},
};

const ALL: RenderRequest =
    RenderRequest { rgb: true, alpha: true, depth: Some(Depth::Accumulated), background: [0.0; 3], antialiased: false };

fn device() -> Device {
    Device::open(&DeviceOptions::default()).unwrap()
}

fn render(scene: &Scene, cameras: &[Camera], request: &RenderRequest) -> Vec<Frame> {
    Renderer::new(&device()).render(scene, cameras, request).unwrap()
}

fn bits(frames: &[Frame]) -> Vec<Vec<u32>> {
    let planes = frames.iter().flat_map(|f| [&f.rgb, &f.alpha, &f.depth]).flatten();
    planes.map(|plane| plane.iter().map(|v| v.to_bits()).collect()).collect()
}

/// Tolerances for colour and for depth D or ED of a golden scene.
fn tolerances(file: &str, antialiased: bool, depth: Depth) -> [ImageTolerance; 2] {
    type T = ImageTolerance;
    match (file == "raster.edge.safetensors", antialiased, depth) {
        (false, _, Depth::Accumulated) => [T::RGB, T::DEPTH],
        (false, _, Depth::Expected) => [T::RGB, T::EXPECTED_DEPTH],
        (true, false, _) => [T::RGB_EDGE, T::DEPTH_EDGE],
        (true, true, _) => [T::RGB_EDGE_ANTIALIASED, T::DEPTH_EDGE_ANTIALIASED],
    }
}

#[test]
fn equals_the_goldens() {
    let mut renderer = Renderer::new(&device());
    for file in golden::list("raster.") {
        let Some(golden) = Golden::open(&file).filter(|g| g.has("v153/classic/rgb")) else { continue };
        let (scene, cameras) = (golden_scene(&golden), golden_cameras(&golden));
        for (mode, antialiased) in [("classic", false), ("antialiased", true)] {
            for (depth, depth_key) in [(Depth::Accumulated, "D"), (Depth::Expected, "ED")] {
                let request = RenderRequest { antialiased, depth: Some(depth), ..ALL };
                let frames = renderer.render(&scene, &cameras, &request).unwrap();
                let [colour, z] = tolerances(&file, antialiased, depth);
                let case = format!("v153/{mode}");
                compare(&golden, &case, "rgb", &frames, |f| &f.rgb, colour);
                compare(&golden, &case, "alpha", &frames, |f| &f.alpha, colour);
                compare(&golden, &case, depth_key, &frames, |f| &f.depth, z);
            }
        }
        let background = <[f32; 3]>::try_from(golden.f32("bg")).unwrap();
        let frames =
            renderer.render(&scene, &cameras, &RenderRequest { background, ..RenderRequest::default() }).unwrap();
        let [colour, _] = tolerances(&file, false, Depth::Accumulated);
        compare(&golden, "v153/classic", "rgb_bg", &frames, |f| &f.rgb, colour);
    }
}

fn compare(
    golden: &Golden,
    case: &str,
    output: &str,
    frames: &[Frame],
    plane: fn(&Frame) -> &Option<Vec<f32>>,
    tolerance: ImageTolerance,
) {
    let key = format!("{case}/{output}");
    let values: Vec<f32> = frames.iter().flat_map(|f| plane(f).clone().unwrap()).collect();
    let width = frames[0].width as usize;
    let channels = values.len() / (frames.len() * width * frames[0].height as usize);
    let name = format!("{} {key}", golden.file());
    let unstable = golden.u8(&format!("{case}/unstable"));
    let psnr = assert_images_close(
        &name,
        Picture { values: &values, width, channels },
        &golden.f32(&key),
        &unstable,
        tolerance,
    );
    println!("{name}: {psnr:.1} dB");
}
