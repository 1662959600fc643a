use glam::EulerRot;
use serde_json::{Value, json};
use std::f64::consts::TAU;
use zipsplat::types::poses::write_transforms;
use zipsplat::types::{Dolly, Ellipse, Spline};
use zipsplat_tests::prelude::*;

const LENS: Intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 52.0, cx: 31.0, cy: 25.0 };

fn uneven(count: usize) -> Vec<Camera> {
    let camera = |i: usize| {
        let t = i as f64;
        let rotation = DMat3::from_quat(DQuat::from_euler(EulerRot::YXZ, 1.9 * t, (0.7 * t).sin(), 0.3 * t));
        let translation = DVec3::new(t * t, (2.0 * t).sin(), -3.0 * (t / 2.0).cos());
        let intrinsics = Intrinsics { fx: 50.0 + t, fy: 52.0 + 2.0 * t, cx: 31.0 - t, ..LENS };
        Camera { intrinsics, pose: Pose { rotation, translation } }
    };
    (0..count).map(camera).collect()
}

/// In the plane y = -1, looking at `target`.
fn around(angle: f64, radii: [f64; 2], target: DVec3) -> Camera {
    let translation = DVec3::new(radii[0] * angle.cos(), -1.0, radii[1] * angle.sin()) + DVec3::new(3.0, 0.0, 5.0);
    let forward = (target - translation).normalize();
    let right = forward.cross(DVec3::NEG_Y).normalize();
    let rotation = DMat3::from_cols(right, forward.cross(right), forward);
    Camera { intrinsics: LENS, pose: Pose { rotation, translation } }
}

#[track_caller]
fn assert_rotation(rotation: DMat3) {
    assert!((rotation * rotation.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-12), "{rotation}");
    assert!(rotation.determinant() > 0.0, "{rotation}");
}

fn difference(a: &Camera, b: &Camera) -> f64 {
    let lens = |c: &Camera| [c.intrinsics.fx, c.intrinsics.fy, c.intrinsics.cx, c.intrinsics.cy];
    let numbers = |c: &Camera| [&c.pose.matrix().to_cols_array()[..], &lens(c)].concat();
    numbers(a).iter().zip(numbers(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn splines_pass_their_cameras_smoothly() {
    for (count, closed) in [(2, false), (2, true), (3, false), (7, false), (7, true)] {
        let cameras = uneven(count);
        let spline = Spline::through(&cameras, closed).unwrap();
        assert_eq!(spline.segments(), if closed { count } else { count - 1 });
        for (i, camera) in cameras.iter().enumerate() {
            assert_eq!(spline.at(i as f64), *camera);
            let beside = [i as f64 - 1e-7, i as f64 + 1e-7];
            for beside in beside.into_iter().filter(|b| (0.0..spline.segments() as f64).contains(b)) {
                let gap = difference(&spline.at(beside), camera);
                assert!(gap > 0.0 && gap < 1e-4, "{gap} at {beside} of {count}");
            }
        }
        assert_eq!(spline.at(-1.0), cameras[0]);
        assert_eq!(spline.at(99.0), cameras[if closed { 0 } else { count - 1 }]);
        let frames = spline.sample(100);
        assert_eq!((frames.len(), frames[0]), (100, cameras[0]));
        let last = difference(&frames[99], &cameras[if closed { 0 } else { count - 1 }]);
        assert!(if closed { last > 1e-3 } else { last < 1e-9 }, "{last}");
        for frame in &frames {
            assert_rotation(frame.pose.rotation);
            assert!(frame.validate("frame").is_ok());
        }
    }
}

/// `sample` divides the time equally.
#[test]
fn velocity_does_not_jump() {
    let frames = Spline::through(&uneven(6), true).unwrap().sample(100_000);
    let center = |i: usize| frames[i % frames.len()].pose.translation;
    let step = |i: usize| center(i + 1) - center(i);
    let largest = (0..frames.len()).map(|i| step(i).length()).fold(0.0, f64::max);
    let jump = (0..frames.len()).map(|i| (step(i + 1) - step(i)).length()).fold(0.0, f64::max);
    assert!(jump < 1e-3 * largest, "{jump} of {largest}");
}

#[test]
fn splines_through_equal_steps_are_even() {
    let camera = |i: usize| Camera {
        intrinsics: LENS,
        pose: Pose {
            rotation: DMat3::from_rotation_y(0.2 * i as f64),
            translation: DVec3::new(2.0 * i as f64, 1.0, 0.0),
        },
    };
    let cameras: Vec<Camera> = (0..5).map(camera).collect();
    for (i, frame) in Spline::through(&cameras, false).unwrap().sample(41).iter().enumerate() {
        let t = i as f64 / 10.0;
        assert!(frame.pose.translation.abs_diff_eq(DVec3::new(2.0 * t, 1.0, 0.0), 1e-12), "{t}: {frame:?}");
        // Squad's outer controls are its ends: only inner segments turn evenly.
        let even = frame.pose.rotation.abs_diff_eq(DMat3::from_rotation_y(0.2 * t), 1e-12);
        assert!(even || !(1.0..=3.0).contains(&t), "{t}: {frame:?}");
    }
}

#[test]
fn splines_of_cameras_in_one_place_turn() {
    let turned = |angle: f64| Pose { rotation: DMat3::from_rotation_y(angle), translation: DVec3::ONE };
    let cameras = [0.0, 1.0, 1.0, 2.0].map(|angle| Camera { intrinsics: LENS, pose: turned(angle) });
    for frame in Spline::through(&cameras, false).unwrap().sample(31) {
        assert_rotation(frame.pose.rotation);
        assert_eq!(frame.pose.translation, DVec3::ONE);
    }
    let single = Spline::through(&cameras[1..2], true).unwrap();
    assert_eq!(single.sample(3), [cameras[1]; 3]);
}

/// COLMAP's, of tests/data/bananas: few, far apart, the last far back.
const BANANAS: [([f64; 4], [f64; 3]); 7] = [
    ([0.9071, 0.0451, 0.3568, 0.2188], [-2.374, 0.511, -0.254]),
    ([0.8860, 0.0388, 0.3972, 0.2361], [-3.143, -0.100, 0.861]),
    ([0.8930, 0.0250, 0.3851, 0.2317], [-1.019, 0.175, 2.548]),
    ([0.9871, -0.0125, 0.1268, 0.0967], [3.161, 0.947, -0.757]),
    ([1.0000, 0.0009, -0.0023, 0.0000], [5.935, 1.601, -1.149]),
    ([0.9733, -0.0753, -0.1765, -0.1260], [8.621, -0.479, -1.196]),
    ([0.8447, 0.0220, 0.4239, 0.3260], [-2.560, -1.053, 2.495]),
];

/// Within 3 % of the cameras' extent around their box; aims within a degree of the cameras.
#[test]
fn splines_through_few_cameras_stay_at_the_scene() {
    let camera = |([w, x, y, z], at): ([f64; 4], [f64; 3])| {
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        Camera { intrinsics: LENS, pose: Pose { rotation, translation: at.into() } }
    };
    let cameras = BANANAS.map(camera);
    let bananas = DVec3::new(5.514, 1.466, 8.994);
    let off =
        |camera: &Camera| camera.pose.rotation.z_axis.angle_between(bananas - camera.pose.translation).to_degrees();
    let most = cameras.iter().map(off).fold(0.0, f64::max);
    assert!(most < 3.0, "{most} degrees");
    let places = cameras.map(|camera| camera.pose.translation);
    let (low, high) = (places.into_iter().reduce(DVec3::min).unwrap(), places.into_iter().reduce(DVec3::max).unwrap());
    for closed in [false, true] {
        for (i, frame) in Spline::through(&cameras, closed).unwrap().sample(200).iter().enumerate() {
            let at = frame.pose.translation;
            let outside = at.distance(at.clamp(low, high)) / low.distance(high);
            assert!(outside < 0.03, "{outside} of the extent outside at {i}, {closed}");
            assert!(off(frame) < most + 1.0, "{} degrees off at {i}, {closed}", off(frame));
        }
    }
}

#[test]
fn unusable_cameras_make_no_path() {
    let mut cameras = uneven(3);
    assert!(matches!(Spline::through(&[], false), Err(Error::Argument { .. })));
    assert!(matches!(Ellipse::around(&[], DVec3::ZERO), Err(Error::Argument { .. })));
    assert!(matches!(Ellipse::around(&cameras[..1], DVec3::ZERO), Err(Error::Argument { .. })));
    let upside_down = Pose { rotation: DMat3::from_rotation_z(TAU / 2.0), translation: DVec3::ONE };
    let opposed = [Pose::IDENTITY, upside_down].map(|pose| Camera { intrinsics: LENS, pose });
    assert!(matches!(Ellipse::around(&opposed, DVec3::ZERO), Err(Error::Argument { .. })));
    cameras[2].intrinsics.width += 1;
    let error = Spline::through(&cameras, false).unwrap_err().to_string();
    assert_eq!(error, "size of camera 2: found 65x48, expected 64x48, the first one's");
    cameras[1].pose.translation.x = f64::NAN;
    assert!(matches!(Spline::through(&cameras, false), Err(Error::Argument { .. })));
    assert!(matches!(Ellipse::around(&cameras, DVec3::ZERO), Err(Error::Argument { .. })));
}

#[test]
fn the_ellipse_of_cameras_on_a_circle_is_that_circle() {
    let target = DVec3::new(3.0, 1.0, 5.0);
    for (count, radii) in [(3, [2.0, 2.0]), (7, [2.0, 2.0]), (12, [4.0, 1.5]), (12, [1.5, 4.0])] {
        let cameras: Vec<Camera> = (0..count).map(|i| around(TAU * i as f64 / count as f64, radii, target)).collect();
        let ellipse = Ellipse::around(&cameras, target).unwrap();
        assert!(ellipse.center.abs_diff_eq(DVec3::new(3.0, -1.0, 5.0), 1e-9), "{ellipse:?}");
        assert!(ellipse.target.abs_diff_eq(target, 1e-9) && !ellipse.outward, "{ellipse:?}");
        let frames = ellipse.sample(40);
        assert!(frames[0].translation.abs_diff_eq(cameras[0].pose.translation, 1e-9), "{:?}", frames[0]);
        for frame in &frames {
            let offset = frame.translation - ellipse.center;
            let unit = (offset.x / radii[0]).powi(2) + (offset.z / radii[1]).powi(2);
            assert!((unit - 1.0).abs() < 1e-9 && offset.y.abs() < 1e-9, "{offset}");
            assert_rotation(frame.rotation);
            let forward = (target - frame.translation).normalize();
            assert!(frame.rotation.z_axis.abs_diff_eq(forward, 1e-9), "{frame:?}");
            assert!(frame.rotation.x_axis.y.abs() < 1e-9 && frame.rotation.y_axis.y > 0.0, "upright: {frame:?}");
        }
        assert!(frames.windows(2).all(|pair| pair[0].translation.distance(pair[1].translation) > 0.05));
    }
}

#[test]
fn ellipses_look_where_their_cameras_do() {
    let middle = DVec3::new(3.0, -1.0, 5.0);
    let inward = (0..8).map(|i| around(TAU * f64::from(i) / 8.0, [2.0, 2.0], middle));
    let outward: Vec<Camera> = inward
        .map(|mut camera| {
            camera.pose.rotation *= DMat3::from_rotation_y(TAU / 2.0);
            camera
        })
        .collect();
    let ellipse = Ellipse::around(&outward, DVec3::ZERO).unwrap();
    assert!(ellipse.outward);
    let frame = ellipse.pose(1.0);
    assert!(frame.rotation.z_axis.dot(frame.translation - ellipse.center) > 0.0);
    // Parallel axes do not meet.
    let row = [-1.0, 0.0, 1.0].map(|x| {
        let pose = Pose { translation: DVec3::new(x, 0.0, 0.0), ..Pose::IDENTITY };
        Camera { intrinsics: LENS, pose }
    });
    let ellipse = Ellipse::around(&row, DVec3::new(0.0, 0.0, 9.0)).unwrap();
    assert!(ellipse.target.abs_diff_eq(DVec3::new(0.0, 0.0, 9.0), 1e-6), "{ellipse:?}");
    for frame in ellipse.sample(16) {
        assert_rotation(frame.rotation);
        assert!(frame.translation.with_x(0.0).length() < 1e-9 && frame.rotation.z_axis.z > 0.9, "{frame:?}");
    }
}

#[test]
fn dollies_move_along_the_view_and_zoom_against_it() {
    let camera = uneven(4)[3];
    let dolly = Dolly { camera, distance: 4.0, travel: 0.75, zoom: true };
    let frames = dolly.sample(5);
    assert_eq!((frames.len(), frames[0]), (5, camera));
    let subject = camera.pose.transform(DVec3::new(0.5, -0.25, 4.0));
    let project = |camera: &Camera| {
        let p = camera.pose.inverse().transform(subject);
        let lens = camera.intrinsics;
        [lens.fx * p.x / p.z + lens.cx, lens.fy * p.y / p.z + lens.cy, p.z]
    };
    let [x, y, _] = project(&camera);
    for (i, frame) in frames.iter().enumerate() {
        let [u, v, depth] = project(frame);
        assert!((u - x).abs() < 1e-9 && (v - y).abs() < 1e-9, "({u}, {v}) was ({x}, {y})");
        assert!((depth - (4.0 - 0.75 * i as f64)).abs() < 1e-9, "{depth}");
    }
    assert_eq!(Dolly { zoom: false, ..dolly }.at(1.0).intrinsics, camera.intrinsics);
    assert!(dolly.validate().is_ok() && Dolly { travel: -2.0, ..dolly }.validate().is_ok());
    for (distance, travel) in [(4.0, 1.0), (4.0, f64::NAN), (0.0, 0.5), (-1.0, 0.5), (f64::NAN, 0.5)] {
        assert!(Dolly { distance, travel, ..dolly }.validate().is_err(), "{distance}, {travel}");
    }
}

/// Supported by every format.
fn plain() -> Vec<Camera> {
    let lens = |focal: f64| Intrinsics { fx: focal, fy: focal, cx: 32.0, cy: 24.0, ..LENS };
    uneven(4).iter().map(|camera| Camera { intrinsics: lens(camera.intrinsics.fx), ..*camera }).collect()
}

fn numbers(matrix: glam::DMat4) -> Vec<f64> {
    matrix.transpose().to_cols_array().to_vec()
}

fn rows(matrix: glam::DMat4) -> Vec<Vec<f64>> {
    numbers(matrix).chunks(4).map(<[f64]>::to_vec).collect()
}

fn read(name: &str, file: &Value) -> zipsplat::Result<Vec<Camera>> {
    let poses = read_as(name, file.to_string(), |path| Capture::open_cameras(path, &LENS))?;
    Ok(poses.frames.iter().map(|frame| frame.camera).collect())
}

#[track_caller]
fn assert_cameras(found: &[Camera], expected: &[Camera]) {
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!((found.intrinsics.width, found.intrinsics.height), (64, 48));
        assert!(difference(found, expected) < 1e-9, "{found:?}, {expected:?}");
    }
}

#[test]
fn every_format_gives_the_same_cameras() {
    let cameras = plain();
    let folder = tempfile::TempDir::new().expect("a temporary folder");
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &cameras, &["a.png", "b.png", "c.png", "d.png"]).unwrap();
    let transforms: Vec<Camera> =
        Capture::open_cameras(&path, &LENS).unwrap().frames.iter().map(|f| f.camera).collect();
    assert_cameras(&transforms, &cameras);

    // x right, y up, z backward.
    let opengl = glam::DMat4::from_diagonal([1.0, -1.0, -1.0, 1.0].into());
    let frame = |camera: &Camera| {
        let fov = 2.0 * (24.0 / camera.intrinsics.fy).atan().to_degrees();
        json!({ "camera_to_world": numbers(camera.pose.matrix() * opengl), "fov": fov, "aspect": 64.0 / 48.0 })
    };
    let frames: Vec<Value> = cameras.iter().map(frame).collect();
    let file = json!({
        "camera_type": "perspective", "render_height": 48, "render_width": 64, "camera_path": frames, "fps": 24,
        "seconds": 4, "smoothness_value": 0.5, "is_cycle": false, "crop": null,
    });
    assert_cameras(&read("camera_path.json", &file).unwrap(), &transforms);

    let lens = |camera: &Camera| {
        let i = camera.intrinsics;
        json!({ "fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy, "width": 64, "height": 48 })
    };
    let with = |key: &str, matrix: Value, camera: &Camera| {
        let mut object = lens(camera);
        object[key] = matrix;
        object
    };
    let matrices = |c: &Camera| with("matrix", json!(rows(c.pose.matrix())), c);
    let viewmats = |c: &Camera| with("viewmat", json!(numbers(c.view_matrix())), c);
    let short =
        |c: &Camera| json!({ "matrix": rows(c.pose.matrix())[..3], "fx": c.intrinsics.fx, "width": 64, "height": 48 });
    let list = |element: &dyn Fn(&Camera) -> Value| Value::Array(cameras.iter().map(element).collect());
    for file in [list(&matrices), list(&viewmats), list(&short)] {
        assert_cameras(&read("list.json", &file).unwrap(), &transforms);
    }
    let bare: Vec<Camera> = cameras.iter().map(|camera| Camera { intrinsics: LENS, ..*camera }).collect();
    assert_cameras(&read("bare.json", &list(&|c: &Camera| json!(rows(c.pose.matrix())))).unwrap(), &bare);
}

#[test]
fn malformed_files_are_named_with_the_place() {
    let identity = numbers(glam::DMat4::IDENTITY);
    let frame = |fov: Value| json!({ "camera_to_world": identity, "fov": fov });
    let path = |frames: Value| json!({ "render_width": 64, "render_height": 48, "camera_path": frames });
    let sheared = [1.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    for (file, place) in [
        (json!({ "camera_path": [frame(json!(50))] }), "render_width"),
        (path(json!(3)), "camera_path: expected a list"),
        (path(json!([frame(json!(50)), frame(json!(180))])), "camera_path[1].fov"),
        (path(json!([frame(Value::Null)])), "camera_path[0].fov"),
        (path(json!([{ "camera_to_world": [1, 2], "fov": 50 }])), "camera_path[0].camera_to_world"),
        (path(json!([{ "camera_to_world": sheared, "fov": 50 }])), "camera_path[0], rotation"),
        (path(json!([{ "camera_to_world": identity, "fov": 50, "camera_type": "fisheye" }])), "found fisheye"),
        (json!([identity, [[1, 0, 0], [0, 1, 0]]]), "[1]: expected a matrix"),
        (json!([identity, 3]), "[1]: expected a matrix"),
        (json!([{ "matrix": identity, "viewmat": identity }]), "[0]: expected a matrix"),
        (json!([{ "matrix": identity, "fx": 3 }]), "[0]: found a part of a lens"),
        (json!([{ "matrix": identity, "fx": "3", "width": 4, "height": 4 }]), "[0].fx"),
        (json!([{ "matrix": identity, "fx": 3, "width": 4.5, "height": 4 }]), "[0].width"),
        (json!([{ "viewmat": sheared }]), "[0], rotation"),
        (json!({ "neither": 1 }), "frames"),
    ] {
        assert_malformed("bad.json", file.to_string(), |path| Capture::open_cameras(path, &LENS), &[place]);
    }
}
