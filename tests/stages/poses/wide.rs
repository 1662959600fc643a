use super::{assert_format_error, assert_same_pose};
use serde_json::json;
use std::f64::consts::{PI, TAU};
use zipsplat::types::poses::{CaptureView, write_colmap, write_frames};
use zipsplat::types::{Distortion, Lens};
use zipsplat_tests::prelude::*;

const EYE: [[f64; 4]; 4] = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
const K: [f64; 4] = [-0.03, 0.01, -0.002, 0.0003];
/// OpenCV's k1, k2, p1, p2, k3 to k6.
const FULL: [f64; 8] = [0.4, 0.05, 0.001, -0.002, 0.01, 0.75, 0.2, 0.03];

/// A wide lens by independent formulas.
struct Wide {
    model: &'static str,
    size: [u32; 2],
    focal: f64,
    views: usize,
    project: fn(DVec3) -> Option<[f64; 2]>,
}

fn fisheye(ray: DVec3) -> Option<[f64; 2]> {
    let (angle, azimuth) = ((ray.z / ray.length()).acos(), ray.y.atan2(ray.x));
    let bent = angle + K[0] * angle.powi(3) + K[1] * angle.powi(5) + K[2] * angle.powi(7) + K[3] * angle.powi(9);
    Some([azimuth.cos() * bent, azimuth.sin() * bent])
}

fn equirectangular(ray: DVec3) -> Option<[f64; 2]> {
    Some([ray.x.atan2(ray.z), (ray.y / ray.length()).asin()])
}

fn full(ray: DVec3) -> Option<[f64; 2]> {
    let [k1, k2, p1, p2, k3, k4, k5, k6] = FULL;
    let (x, y) = (ray.x / ray.z, ray.y / ray.z);
    let s = x * x + y * y;
    let factor = (1.0 + k1 * s + k2 * s * s + k3 * s * s * s) / (1.0 + k4 * s + k5 * s * s + k6 * s * s * s);
    let tangential = [2.0 * p1 * x * y + p2 * (s + 2.0 * x * x), p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y];
    (ray.z > 0.0).then_some([factor * x + tangential[0], factor * y + tangential[1]])
}

/// A circle of 202 degrees, one across of 130, a rational lens of about 120, the sphere.
const LENSES: [Wide; 4] = [
    Wide { model: "OPENCV_FISHEYE", size: [240, 240], focal: 70.0, views: 5, project: fisheye },
    Wide { model: "OPENCV_FISHEYE", size: [256, 160], focal: 116.0, views: 3, project: fisheye },
    Wide { model: "FULL_OPENCV", size: [256, 160], focal: 105.0, views: 3, project: full },
    Wide { model: "EQUIRECTANGULAR", size: [320, 160], focal: 320.0 / TAU, views: 8, project: equirectangular },
];

impl Wide {
    fn pixel(&self, ray: DVec3) -> Option<[f64; 2]> {
        let [x, y] = (self.project)(ray)?;
        Some([self.focal * x + f64::from(self.size[0]) / 2.0, self.focal * y + f64::from(self.size[1]) / 2.0])
    }

    /// By bisection of the angle from the axis.
    fn ray(&self, [u, v]: [f64; 2]) -> DVec3 {
        let [x, y] = [u - f64::from(self.size[0]) / 2.0, v - f64::from(self.size[1]) / 2.0].map(|at| at / self.focal);
        if self.model == "EQUIRECTANGULAR" {
            return DVec3::new(y.cos() * x.sin(), y.sin(), y.cos() * x.cos());
        }
        let direction = |angle: f64| {
            let azimuth = y.atan2(x);
            DVec3::new(angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos())
        };
        let (mut low, mut high) = (0.0, if self.model == "FULL_OPENCV" { 1.4 } else { 2.5 });
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            let [a, b] = (self.project)(direction(middle)).unwrap();
            *if a.hypot(b) < x.hypot(y) { &mut low } else { &mut high } = middle;
        }
        direction(low)
    }

    fn json(&self) -> serde_json::Value {
        let mut file = json!({
            "camera_model": self.model, "w": self.size[0], "h": self.size[1], "fl_x": self.focal,
            "frames": [{"file_path": "a.png", "transform_matrix": EYE}],
        });
        let keys = match self.model {
            "FULL_OPENCV" => vec!["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
            "OPENCV_FISHEYE" => vec!["k1", "k2", "k3", "k4"],
            _ => Vec::new(),
        };
        let values = if self.model == "FULL_OPENCV" { FULL.to_vec() } else { K.to_vec() };
        keys.iter().zip(values).for_each(|(key, value)| file[key] = json!(value));
        file
    }

    fn colmap(&self) -> String {
        let ([w, h], f) = (self.size, self.focal);
        let (cx, cy) = (f64::from(w) / 2.0, f64::from(h) / 2.0);
        let numbers = match self.model {
            "FULL_OPENCV" => [vec![f, f, cx, cy], FULL.to_vec()].concat(),
            "OPENCV_FISHEYE" => [vec![f, f, cx, cy], K.to_vec()].concat(),
            _ => vec![f64::from(w), f64::from(h)],
        };
        let numbers: Vec<String> = numbers.iter().map(ToString::to_string).collect();
        format!("1 {} {w} {h} {}\n", self.model, numbers.join(" "))
    }

    fn capture(&self, folder: &Path) -> Capture {
        fs::write(folder.join("transforms.json"), self.json().to_string()).unwrap();
        Capture::open(folder.join("transforms.json")).unwrap()
    }
}

fn view_ray(camera: &Camera, [u, v]: [f64; 2]) -> DVec3 {
    let i = camera.intrinsics;
    (camera.pose.rotation * DVec3::new((u - i.cx) / i.fx, (v - i.cy) / i.fy, 1.0)).normalize()
}

/// Color of the surroundings, 0..1.
fn light(ray: DVec3) -> [f64; 3] {
    let d = ray.normalize();
    [DVec3::new(9.0, 4.0, -7.0), DVec3::new(-3.0, 11.0, 5.0), DVec3::new(6.0, -8.0, 8.0)]
        .map(|wave| 0.5 + 0.3 * wave.dot(d).sin() + 0.15 * DVec3::new(2.0 * wave.z, wave.x, wave.y).dot(d).cos())
}

fn picture([width, height]: [u32; 2], ray: impl Fn([f64; 2]) -> DVec3) -> Image {
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| [x, y].map(|at| f64::from(at) + 0.5)));
    let rgb = pixels.flat_map(|at| light(ray(at)).map(|value| (255.0 * value).round() as u8)).collect();
    Image::new(width, height, rgb).unwrap()
}

fn psnr(image: &Image, truth: &Image) -> f64 {
    let (a, b) = (image.kept(&image.rgb), image.kept(&truth.rgb));
    let sum: f64 = a.iter().zip(b.iter()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    20.0 * 255.0f64.log10() - 10.0 * (sum / a.len() as f64).log10()
}

#[test]
fn places_are_those_of_independent_formulas() {
    let folder = tempfile::tempdir().unwrap();
    for lens in &LENSES {
        let capture = lens.capture(folder.path());
        assert_eq!(capture.frames.len(), lens.views, "{}", lens.model);
        let (mut beyond, mut compared) = (0, 0);
        for frame in &capture.frames {
            let size = frame.size(lens.size);
            assert_eq!(size, [frame.camera.intrinsics.width, frame.camera.intrinsics.height]);
            let hfov = frame.camera.intrinsics.hfov().to_degrees();
            assert!((hfov - 100.0).abs() < 1e-9, "{hfov}");
            let own = frame.lens.unwrap();
            let place = own.places(lens.size).unwrap();
            for (row, column) in (0..size[1]).step_by(3).flat_map(|row| (0..size[0]).step_by(3).map(move |c| (row, c)))
            {
                let ray = view_ray(&frame.camera, [f64::from(column) + 0.5, f64::from(row) + 0.5]);
                let (x, y) = place(row as usize, column as usize);
                if x.is_nan() {
                    continue;
                }
                let [u, v] = lens.pixel(ray).unwrap();
                assert!((x - u).abs() + (y - v).abs() < 1e-9, "{}: {ray} at {x} {y}, not {u} {v}", lens.model);
                beyond += usize::from(ray.z < 0.0);
                compared += 1;
            }
        }
        assert!(compared > 2000 && (beyond > 100) == (lens.size[0] == 240 || lens.views == 8), "{beyond} {compared}");
    }
}

#[test]
fn views_show_what_the_photo_shows() {
    let folder = tempfile::tempdir().unwrap();
    for lens in &LENSES {
        let capture = lens.capture(folder.path());
        let is_seen = |ray: DVec3| capture.frames.iter().any(|frame| frame.camera.project(ray).is_some());
        // Fibonacci sphere.
        let ray = |k: usize| {
            let z = 1.0 - (2 * k + 1) as f64 / 5000.0;
            let turn = k as f64 * PI * (3.0 - 5.0f64.sqrt());
            DVec3::new((1.0 - z * z).sqrt() * turn.cos(), (1.0 - z * z).sqrt() * turn.sin(), z)
        };
        let is_shown = |ray: &DVec3| {
            let inside = |at: f64, side: u32| (0.0..f64::from(side)).contains(&at);
            let angle = ray.z.acos().to_degrees();
            // The circle of the first lens has a radius of 101 degrees.
            let is_limited = lens.views == 8 || angle < if lens.views == 5 { 97.0 } else { 75.0 };
            is_limited && lens.pixel(*ray).is_some_and(|[u, v]| inside(u, lens.size[0]) && inside(v, lens.size[1]))
        };
        let shown: Vec<DVec3> = (0..5000).map(ray).filter(is_shown).collect();
        let seen = shown.iter().filter(|ray| is_seen(**ray)).count();
        let least = if lens.views == 8 { 1.0 } else { 0.97 };
        assert!(seen as f64 >= least * shown.len() as f64, "{}: {seen} of {}", lens.model, shown.len());
    }
}

#[test]
fn views_are_those_of_pinhole_cameras() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    for lens in &LENSES {
        picture(lens.size, |at| lens.ray(at)).save_png(&path).unwrap();
        let compared = |capture: &Capture| -> f64 {
            let one = |frame: &CaptureView| {
                let view = frame.open(&path).unwrap();
                let size = [view.width, view.height];
                psnr(&view, &picture(size, |at| view_ray(&frame.camera, at)))
            };
            capture.frames.iter().map(one).fold(f64::INFINITY, f64::min)
        };
        let exact = compared(&lens.capture(folder.path()));
        assert!(exact > 38.0, "{}: {exact}", lens.model);
        if lens.model == "EQUIRECTANGULAR" {
            continue;
        }
        let mut file = lens.json();
        file["k1"] = json!(file["k1"].as_f64().unwrap() + 0.02);
        fs::write(folder.path().join("transforms.json"), file.to_string()).unwrap();
        let wrong = compared(&Capture::open(folder.path()).unwrap());
        assert!(wrong < exact - 6.0, "{}: {wrong}, exact {exact}", lens.model);
    }
}

#[test]
fn colmap_models_have_the_same_views() {
    let folder = tempfile::tempdir().unwrap();
    for lens in &LENSES {
        let json = lens.capture(folder.path());
        let model = tempfile::tempdir().unwrap();
        fs::write(model.path().join("cameras.txt"), lens.colmap()).unwrap();
        fs::write(model.path().join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
        let colmap = Capture::open(model.path()).unwrap();
        assert_eq!(colmap.frames, json.frames, "{}", lens.model);
        assert_eq!((&colmap.warnings, colmap.warnings.len()), (&json.warnings, 1));
        assert!(colmap.warnings[0].contains(&format!("1 of them, are cut into {} pinhole views", lens.views)));
        write_colmap(model.path(), &json.frames, &[]).unwrap();
        assert_eq!(Capture::open(model.path()).unwrap().frames, json.frames, "{}", lens.model);
        write_frames(folder.path().join("again.json"), &json.frames, None).unwrap();
        let again = folder.path().join("again.json");
        let text: serde_json::Value = serde_json::from_slice(&fs::read(&again).unwrap()).unwrap();
        assert_eq!(text["frames"].as_array().unwrap().len(), 1);
        let read = Capture::open(&again).unwrap();
        for (i, (read, frame)) in read.frames.iter().zip(&json.frames).enumerate() {
            assert_eq!((&read.name, read.lens), (&frame.name, frame.lens));
            assert_same_pose(&read.camera.pose, &frame.camera.pose, i);
        }
        let mut moved = json.frames.clone();
        moved[1].camera.pose.translation.x += 0.1;
        assert_refused(write_colmap(model.path(), &moved, &[]), &["a.png", "view 0"]);
        write_frames(&again, &moved, None).unwrap();
        let read = Capture::open(&again).unwrap();
        assert_eq!(read.frames.len(), moved.len());
        for (i, (read, frame)) in read.frames.iter().zip(&moved).enumerate() {
            assert_eq!((&read.name, read.lens), (&frame.name, frame.lens));
            assert_same_pose(&read.camera.pose, &frame.camera.pose, i);
        }
        let photos = read.per_view(vec!["a.png".into()]).unwrap();
        assert_eq!(photos.len(), lens.views);
        let frames: Vec<CaptureView> = read.frames_of(&photos).unwrap().into_iter().cloned().collect();
        assert_eq!(frames, read.frames);
    }
}

#[test]
fn masks_are_cut_alike() {
    let folder = tempfile::tempdir().unwrap();
    let lens = &LENSES[3];
    let capture = lens.capture(folder.path());
    // The view down and the lower halves of those around.
    let mask = (0..320 * 160).map(|at| if at / 320 < 80 { 255 } else { 0 }).collect();
    let photo = picture(lens.size, |at| lens.ray(at)).with_mask(mask).unwrap();
    for (i, frame) in capture.frames.iter().enumerate() {
        let view = frame.lens.unwrap().undistort(&photo).unwrap();
        let ignored = (0..view.rgb.len() / 3).filter(|at| view.ignores(*at)).count() as f64;
        let share = ignored / (view.rgb.len() / 3) as f64;
        let expected = [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 1.0][i];
        assert!((share - expected).abs() < 0.02, "view {i}: {share}");
    }
    let lens = &LENSES[0];
    let capture = lens.capture(folder.path());
    let photo = picture(lens.size, |at| lens.ray(at));
    let edge = lens.ray([240.0, 120.0]).z.acos().to_degrees();
    for frame in &capture.frames {
        let view = frame.lens.unwrap().undistort(&photo).unwrap();
        for at in 0..view.rgb.len() / 3 {
            let (x, y) = (at % view.width as usize, at / view.width as usize);
            let angle = view_ray(&frame.camera, [x as f64 + 0.5, y as f64 + 0.5]).z.acos().to_degrees();
            assert!(view.ignores(at) == (angle > edge) || (angle - edge).abs() < 1.0, "{angle} degrees");
        }
    }
}

#[test]
fn unusable_wide_lenses_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    let refused = |lens: &Wide, change: &dyn Fn(&mut serde_json::Value), parts: &[&str]| {
        let mut file = lens.json();
        change(&mut file);
        fs::write(&path, file.to_string()).unwrap();
        assert_format_error(&path, &[&["transforms.json", "frames[0]"], parts].concat());
    };
    let without = |file: &mut serde_json::Value| file.as_object_mut().unwrap().retain(|key, _| !key.starts_with('k'));
    refused(&LENSES[0], &without, &["fisheye", "found none", "k1 to k4"]);
    refused(&LENSES[3], &|file| file["h"] = json!(170), &["320x170", "twice as wide as high"]);
    refused(&LENSES[0], &|file| file["frames"][0]["view"] = json!(5), &["view", "found 5", "below 5"]);
    refused(&LENSES[0], &|file| file["frames"][0]["view"] = json!("left"), &["view", "left"]);
    refused(&LENSES[0], &|file| file["camera_model"] = json!("FISHEYE624"), &["FISHEYE624", "OPENCV_FISHEYE"]);
    // Folds back within two degrees.
    refused(&LENSES[0], &|file| file["k1"] = json!(-900.0), &["distortion"]);
    fs::remove_file(&path).unwrap();
    let model = folder.path();
    fs::write(model.join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
    fs::write(model.join("cameras.txt"), "1 OPENCV_FISHEYE 240 240 70 70 120 120 0.1\n").unwrap();
    assert_format_error(model, &["cameras.txt", "PARAMS[5]", "expected a number"]);
    fs::write(model.join("cameras.txt"), "1 EQUIRECTANGULAR 240 240 240 240\n").unwrap();
    assert_format_error(model, &["cameras.txt", "240x240", "twice as wide as high"]);
}

/// Lenses of the interface keep their views.
#[test]
fn a_lens_up_to_the_limit_is_one_view() {
    let intrinsics = Intrinsics { width: 200, height: 100, fx: 110.0, fy: 110.0, cx: 100.0, cy: 50.0 };
    let lens = |fx: f64| Lens {
        intrinsics: Intrinsics { fx, fy: fx, ..intrinsics },
        distortion: Distortion::Fisheye([0.0; 4]),
        view: 0,
    };
    // 104 and 115 degrees.
    assert_eq!([110.0, 100.0].map(|fx| lens(fx).view_count()), [1, 3]);
    assert_eq!(lens(110.0).view_size([400, 200]), [400, 200]);
    let [w, h] = lens(100.0).view_size([400, 200]);
    assert_eq!((w, h), (476, 476));
}
