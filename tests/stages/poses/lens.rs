use serde_json::json;
use zipsplat::types::poses::{CaptureView, write_frames};
use zipsplat_tests::prelude::*;

const SIZE: [u32; 2] = [240, 180];
const LENS: Intrinsics = Intrinsics { width: SIZE[0], height: SIZE[1], fx: 200.0, fy: 190.0, cx: 118.0, cy: 93.0 };
const SPOT: f64 = 2.5;

/// OpenCV's formulas.
type Distort = fn([f64; 2]) -> [f64; 2];

fn radial([x, y]: [f64; 2], factor: impl Fn(f64) -> f64) -> [f64; 2] {
    let f = factor(x * x + y * y);
    [f * x, f * y]
}

fn opencv([x, y]: [f64; 2]) -> [f64; 2] {
    let (k1, k2, p1, p2) = (-0.21, 0.06, 0.004, -0.006);
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2.powi(2);
    [x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]
}

fn fisheye([x, y]: [f64; 2]) -> [f64; 2] {
    let r = x.hypot(y);
    let t = r.atan();
    let bent = t * (1.0 + 0.03 * t.powi(2) - 0.01 * t.powi(4) + 0.002 * t.powi(6) - 0.001 * t.powi(8));
    if r == 0.0 { [0.0; 2] } else { [x / r * bent, y / r * bent] }
}

fn pixel(i: &Intrinsics, [x, y]: [f64; 2]) -> [f64; 2] {
    [i.fx * x + i.cx, i.fy * y + i.cy]
}

fn spots() -> Vec<[f64; 2]> {
    (-2..=2).flat_map(|row| (-2..=2).map(move |column| [0.2 * f64::from(column), 0.15 * f64::from(row)])).collect()
}

fn photo(lens: &Intrinsics, distort: Distort) -> Image {
    let centers: Vec<_> = spots().into_iter().map(|spot| pixel(lens, distort(spot))).collect();
    let light = |x: f64, y: f64| {
        let near = |[u, v]: &[f64; 2]| (-((x - u).powi(2) + (y - v).powi(2)) / (2.0 * SPOT * SPOT)).exp();
        20.0 + 200.0 * centers.iter().map(near).sum::<f64>()
    };
    let pixels = (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| [x, y].map(|at| f64::from(at) + 0.5)));
    Image::new(SIZE[0], SIZE[1], pixels.flat_map(|[x, y]| [light(x, y) as u8; 3]).collect()).unwrap()
}

/// Of the spot near a pixel.
fn center(image: &Image, [u, v]: [f64; 2]) -> [f64; 2] {
    let (mut sum, mut moment) = (0.0, [0.0; 2]);
    let reach = |at: f64, most: u32| (at - 9.0).max(0.0) as u32..((at + 9.0) as u32).min(most);
    for y in reach(v, image.height) {
        for x in reach(u, image.width) {
            let weight = f64::from(image.rgb[3 * (y * image.width + x) as usize].saturating_sub(25));
            sum += weight;
            moment[0] += weight * (f64::from(x) + 0.5);
            moment[1] += weight * (f64::from(y) + 0.5);
        }
    }
    moment.map(|m| m / sum)
}

#[track_caller]
fn assert_undone(name: &str, frame: &CaptureView, folder: &Path, lens: &Intrinsics, distort: Distort) {
    photo(lens, distort).save_png(folder.join("a.png")).unwrap();
    let (pinhole, image) = (frame.camera.intrinsics, frame.open(folder.join("a.png")).unwrap());
    assert_eq!([image.width, image.height], SIZE, "{name}");
    for spot in spots() {
        let (bent, truth) = (pixel(lens, distort(spot)), pixel(&pinhole, spot));
        let found = center(&image, truth);
        let off = (found[0] - truth[0]).hypot(found[1] - truth[1]);
        assert!(off < 0.15, "{name}: spot {spot:?} at {found:?}, not {truth:?}, in the photo at {bent:?}");
    }
    let border = (0..=60).map(|k| f64::from(k) / 60.0);
    let [w, h] = SIZE.map(f64::from);
    let points = border.flat_map(|t| [[t * w, 0.0], [t * w, h], [0.0, t * h], [w, t * h]]);
    let inside = points.map(|[u, v]| {
        let direction = [(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy];
        let [u, v] = pixel(lens, distort(direction));
        u.min(w - u).min(v).min(h - v)
    });
    let margin = inside.fold(f64::INFINITY, f64::min);
    let tight = pinhole.fx == lens.fx || margin < 0.5;
    assert!(margin > -0.2 && tight, "{name}: the border lies {margin} pixels within the photo");
}

#[test]
fn spots_stand_where_the_pinhole_camera_of_a_colmap_model_sees_them() {
    let cases: [(&str, &str, Distort); 6] = [
        ("SIMPLE_RADIAL 240 180 200 118 93", "-0.15", |d| radial(d, |r2| 1.0 - 0.15 * r2)),
        ("RADIAL 240 180 200 118 93", "0.12 0.05", |d| radial(d, |r2| 1.0 + 0.12 * r2 + 0.05 * r2 * r2)),
        ("OPENCV 240 180 200 190 118 93", "-0.21 0.06 0.004 -0.006", opencv),
        ("FULL_OPENCV 240 180 200 190 118 93", "0.3 0.1 0 0 0.02 0.5 0.05 0.01", |d| {
            radial(d, |s| {
                (1.0 + 0.3 * s + 0.1 * s.powi(2) + 0.02 * s.powi(3))
                    / (1.0 + 0.5 * s + 0.05 * s.powi(2) + 0.01 * s.powi(3))
            })
        }),
        ("OPENCV_FISHEYE 240 180 200 190 118 93", "0.03 -0.01 0.002 -0.001", fisheye),
        ("PINHOLE 240 180 200 190 118 93", "", |d| d),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (lens, coefficients, distort) in cases {
        let fy = if lens.contains("200 118") { 200.0 } else { LENS.fy };
        fs::write(folder.path().join("cameras.txt"), format!("1 {lens} {coefficients}\n")).unwrap();
        fs::write(folder.path().join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
        let poses = Capture::open(folder.path()).unwrap();
        let frame = &poses.frames[0];
        let is_plain = coefficients.is_empty();
        assert_eq!((frame.lens.is_none(), poses.warnings.is_empty()), (is_plain, true), "{lens}");
        assert_undone(lens, frame, folder.path(), &Intrinsics { fy, ..LENS }, distort);
    }
}

#[test]
fn spots_stand_where_the_pinhole_camera_of_a_transforms_file_sees_them() {
    let eye = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    let cases: [(&str, serde_json::Value, Distort); 3] = [
        ("OPENCV", json!({"k1": -0.21, "k2": 0.06, "p1": 0.004, "p2": -0.006}), opencv),
        ("OPENCV", json!({"k1": -0.1, "k2": 0.02, "k3": 0.01, "k4": 0.03}), |d| {
            radial(d, |s| 1.0 - 0.1 * s + 0.02 * s.powi(2) + 0.01 * s.powi(3) + 0.03 * s.powi(4))
        }),
        ("OPENCV_FISHEYE", json!({"k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": -0.001}), fisheye),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (model, coefficients, distort) in cases {
        let mut file = json!({
            "camera_model": model, "w": SIZE[0], "h": SIZE[1], "fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx, "cy": LENS.cy,
            "frames": [{"file_path": "a.png", "transform_matrix": eye}],
        });
        file.as_object_mut().unwrap().extend(coefficients.as_object().unwrap().clone());
        fs::write(folder.path().join("transforms.json"), file.to_string()).unwrap();
        let poses = Capture::open(folder.path()).unwrap();
        assert!(poses.frames[0].lens.is_some() && poses.warnings.is_empty(), "{:?}", poses.warnings);
        assert_undone(model, &poses.frames[0], folder.path(), &LENS, distort);
        // JSON readers need not be bit-exact; these intrinsics are.
        let camera = Camera { intrinsics: LENS, ..poses.frames[0].camera };
        let pinhole = CaptureView { name: "b.png".into(), photo: None, camera, lens: None };
        let distorted = CaptureView { photo: None, ..poses.frames[0].clone() };
        for frames in [vec![distorted.clone()], vec![distorted.clone(), pinhole.clone()]] {
            write_frames(folder.path().join("again.json"), &frames, Some("cloud.ply")).unwrap();
            let again = Capture::open(folder.path().join("again.json")).unwrap();
            let read: Vec<CaptureView> =
                again.frames.into_iter().map(|frame| CaptureView { photo: None, ..frame }).collect();
            assert_eq!((read, again.points), (frames, None), "{model}");
            fs::write(folder.path().join("cloud.ply"), "").unwrap();
            let points = Capture::open(folder.path().join("again.json")).unwrap().points;
            assert_eq!(points, Some(folder.path().join("cloud.ply")));
            fs::remove_file(folder.path().join("cloud.ply")).unwrap();
        }
    }
}
