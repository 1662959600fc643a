use flate2::Compression;
use serde_json::json;
use zip::CompressionMethod;
use zipsplat::types::poses::write_transforms;
use zipsplat::types::{Orbit, SaveOptions, SceneFormat};
use zipsplat_tests::architectures::pico;
use zipsplat_tests::pickles::{self, View, dict, row_major};
use zipsplat_tests::prelude::*;

pub const LENS: Intrinsics = Intrinsics { width: 64, height: 48, fx: 70.0, fy: 71.5, cx: 31.25, cy: 24.5 };

pub fn scene(extension: &str, sh_degree: u32) -> Vec<u8> {
    let scene: Scene = random_scene(7, sh_degree, 0.1);
    bytes_of(&format!("scene.{extension}"), |path| scene.save(path).unwrap())
}

pub fn spz4(sh_degree: u32) -> Vec<u8> {
    random_scene(7, sh_degree, 0.1).encode(SceneFormat::Spz, &SaveOptions { spz_version: 4 }, None).unwrap()
}

/// Damage behind the SPZ's checksum would not reach the parser.
pub fn deflated(bytes: &[u8]) -> Vec<u8> {
    gzip(bytes, Compression::fast())
}

pub fn ascii_ply() -> Vec<u8> {
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let properties: String = names.split(' ').map(|name| format!("property float {name}\n")).collect();
    let rows = "0.1 0.2 3 0.5 0.25 -0.5 1.5 -3 -3.5 -4 1 0 0.1 0\n".repeat(3);
    format!("ply\nformat ascii 1.0\ncomment made here\nelement vertex 3\n{properties}end_header\n{rows}").into_bytes()
}

pub fn packed_ply() -> Vec<u8> {
    std::fs::read(golden::find("scenes/scene.compressed.ply").expect("it is committed")).unwrap()
}

fn cameras() -> Vec<Camera> {
    let orbit = Orbit { center: glam::DVec3::new(0.5, -1.0, 7.0), radius: 3.0 };
    orbit.sweep(3, 13.0, 300.0, -25.0).into_iter().map(|pose| Camera { intrinsics: LENS, pose }).collect()
}

pub fn transforms() -> Vec<u8> {
    bytes_of("transforms.json", |path| write_transforms(path, &cameras(), &["a.png", "b.png", "c.png"]).unwrap())
}

pub fn camera_path() -> Vec<u8> {
    let frame = |camera: &Camera| {
        let matrix = camera.pose.matrix().transpose().to_cols_array();
        json!({ "camera_to_world": matrix.to_vec(), "fov": 50.0, "aspect": 1.3 })
    };
    let frames: Vec<_> = cameras().iter().map(frame).collect();
    let path = json!({ "camera_type": "perspective", "render_height": 48, "render_width": 64, "camera_path": frames, "fps": 24 });
    path.to_string().into_bytes()
}

pub fn matrices() -> Vec<u8> {
    let rows = |camera: &Camera| camera.pose.matrix().transpose().to_cols_array().to_vec();
    let list: Vec<_> =
        cameras().iter().map(|c| json!({ "matrix": rows(c), "fx": 70.0, "width": 64, "height": 48 })).collect();
    json!(list).to_string().into_bytes()
}

pub const COLMAP_CAMERAS: &str =
    "# cameras\n1 PINHOLE 64 48 70 71.5 31.25 24.5\n2 OPENCV 64 48 70 71 31 24 0.1 0 0 0\n";
pub const COLMAP_IMAGES: &str =
    "# images\n1 1 0 0 0 0.5 -1 2 1 a.png\n10 20 -1 30 40 7\n2 0.5 0.5 -0.5 0.5 0 0 1 2 b.png\n\n";

pub fn colmap_cameras() -> Vec<u8> {
    let mut out = 1u64.to_le_bytes().to_vec();
    out.extend([1i32, 1].into_iter().flat_map(i32::to_le_bytes));
    out.extend([64u64, 48].into_iter().flat_map(u64::to_le_bytes));
    out.extend([70.0f64, 71.5, 31.25, 24.5].into_iter().flat_map(f64::to_le_bytes));
    out
}

pub fn colmap_images() -> Vec<u8> {
    let mut out = 2u64.to_le_bytes().to_vec();
    for (id, name) in [(1i32, "a.png"), (2, "b.png")] {
        out.extend(id.to_le_bytes());
        out.extend([1.0f64, 0.0, 0.0, 0.0, 0.5, -1.0, 2.0].into_iter().flat_map(f64::to_le_bytes));
        out.extend(1i32.to_le_bytes());
        out.extend([name.as_bytes(), &[0]].concat());
        out.extend(1u64.to_le_bytes());
        out.extend([0; 24]);
    }
    out
}

pub const COLMAP_POINTS: &str = "# points\n7 0.5 -1 2 255 0 10 0.3 1 0 2 0\n9 1 1 4 0 0 0 0.1 2 5\n";

pub fn colmap_points() -> Vec<u8> {
    let mut out = 2u64.to_le_bytes().to_vec();
    for id in [7u64, 9] {
        out.extend(id.to_le_bytes());
        out.extend([0.5f64, -1.0, 2.0].into_iter().flat_map(f64::to_le_bytes));
        out.extend([255, 0, 10]);
        out.extend(0.3f64.to_le_bytes());
        out.extend(2u64.to_le_bytes());
        out.extend([1i32, 0, 2, 0].into_iter().flat_map(i32::to_le_bytes));
    }
    out
}

fn weights() -> Checkpoint {
    Checkpoint::seeded_architecture(pico(), "pico").unwrap()
}

pub fn safetensors() -> Vec<u8> {
    bytes_of("weights.safetensors", |path| weights().save(path, Dtype::F16).unwrap())
}

/// Of [`pico`]: `{"model": {name: tensor}}`, all tensors in storage "0".
pub fn pickle() -> Vec<u8> {
    let (weights, mut offset) = (weights(), 0);
    let elements = pico().parameter_count();
    let tensors: Vec<(&str, Vec<u8>)> = (weights.parameters().iter())
        .map(|(name, shape)| {
            let strides = row_major(shape);
            let view = View { kind: "FloatStorage", key: "0", elements, offset, shape, strides: &strides };
            offset += shape.iter().product::<usize>();
            (name.as_str(), view.pickle())
        })
        .collect();
    [b"\x80\x02", dict(&[("model", dict(&tensors))]).as_slice(), b"."].concat()
}

/// [`pico`]'s storage is zeros.
pub fn archive(pickle: &[u8]) -> Vec<u8> {
    let zeros = vec![0; 4 * pico().parameter_count()];
    pickles::archive(&[("data.pkl", pickle), ("data/0", &zeros)], CompressionMethod::Stored)
}

pub fn photo(format: image::ImageFormat) -> Vec<u8> {
    let picture = image::RgbImage::from_raw(24, 17, noise(24, 17, 3).rgb).unwrap();
    encoded(&picture.into(), format)
}
