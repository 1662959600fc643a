use zipsplat::types::{Orbit, prior_encoding, quaternion_from_matrix};
use zipsplat_tests::prelude::*;

/// Goldens are computed in f32.
const F32_RUN: Tolerance = Tolerance { max: 2e-6, rms: 3e-7 };

fn goldens() -> Golden {
    Golden::committed("geometry.safetensors")
}

fn matrix(rows: &[f64]) -> DMat3 {
    DMat3::from_cols_slice(rows).transpose()
}

fn poses(golden: &Golden, key: &str) -> Vec<Pose> {
    golden.f64(key).chunks(12).map(scenes::pose).collect()
}

/// `[w, h, fx, fy, cx, cy]`.
fn intrinsics(row: &[f64]) -> Intrinsics {
    let &[width, height, fx, fy, cx, cy] = row else { panic!("{row:?} are not 6 values") };
    Intrinsics { width: width as u32, height: height as u32, fx, fy, cx, cy }
}

fn row(i: Intrinsics) -> [f64; 6] {
    [f64::from(i.width), f64::from(i.height), i.fx, i.fy, i.cx, i.cy]
}

fn camera() -> Camera {
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 500.0, fy: 505.0, cx: 320.0, cy: 240.0 };
    Camera { intrinsics, pose: Pose::IDENTITY }
}

#[test]
fn quaternions_follow_the_reference() {
    let golden = goldens();
    let rotations: Vec<DMat3> = golden.f64("quat/R").chunks(9).map(matrix).collect();
    let found: Vec<f64> = rotations.iter().flat_map(quaternion_from_matrix).collect();
    // Near half turns, f32 matrices are the truth.
    assert_close("quat/wxyz", &found, &golden.f64("quat/wxyz"), F32_RUN);
    for (rotation, wxyz) in rotations.iter().zip(found.chunks(4)) {
        assert!(wxyz[0] >= 0.0, "{wxyz:?}");
        let back = matrix_from_quaternion([wxyz[0], wxyz[1], wxyz[2], wxyz[3]]);
        assert!(back.abs_diff_eq(*rotation, 1e-6), "{back} is not {rotation}");
    }
    let scaled = matrix_from_quaternion([2.0, 0.0, 0.0, 2.0]);
    assert!(scaled.abs_diff_eq(DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2), 1e-15), "any length will do");
}

#[test]
fn poses_follow_the_reference() {
    let golden = goldens();
    let data = poses(&golden, "pose/data");
    let inverses: Vec<Pose> = data.iter().map(Pose::inverse).collect();
    assert_close("pose/inv", &scenes::pose_rows(&inverses), &golden.f64("pose/inv"), F32_RUN);
    let composed: Vec<Pose> = data.iter().zip(data.iter().rev()).map(|(a, b)| a.compose(b)).collect();
    assert_close("pose/compose", &scenes::pose_rows(&composed), &golden.f64("pose/compose_with_reversed"), F32_RUN);
    let points = golden.f64("pose/points");
    let moved = data.iter().zip(points.chunks(15)).flat_map(|(pose, points)| {
        points.chunks(3).flat_map(|point| pose.transform(DVec3::from_slice(point)).to_array()).collect::<Vec<_>>()
    });
    assert_close("pose/transform", &moved.collect::<Vec<_>>(), &golden.f64("pose/transform"), F32_RUN);
    let rows = |matrix: fn(&Pose) -> glam::DMat4| -> Vec<f64> {
        data.iter().flat_map(|pose| matrix(pose).transpose().to_cols_array()).collect()
    };
    assert_close("pose/Rt", &rows(Pose::matrix), &golden.f64("pose/Rt"), Tolerance::STORED);
    assert_close("pose/Rt_inv", &rows(Pose::view_matrix), &golden.f64("pose/Rt_inv"), F32_RUN);
    let first = data[0].relative_to(&data[0]);
    assert!(first.matrix().abs_diff_eq(glam::DMat4::IDENTITY, 1e-6), "{first:?}");
    let back = data[0].compose(&data[3].relative_to(&data[0]));
    assert!(back.matrix().abs_diff_eq(data[3].matrix(), 1e-6), "{back:?}");
}

#[test]
fn intrinsics_follow_the_reference() {
    let golden = goldens();
    let fovs: Vec<(f64, f64)> = golden.f64("cam/fov_x").into_iter().zip(golden.f64("cam/fov_y")).collect();
    let lenses: Vec<Intrinsics> = fovs.iter().map(|&(x, y)| Intrinsics::from_fov(640, 480, x, y)).collect();
    let rows = |change: &dyn Fn(&Intrinsics) -> Intrinsics| -> Vec<f64> {
        lenses.iter().flat_map(|lens| row(change(lens))).collect()
    };
    let check = |key: &str, found: &[f64]| assert_close(key, found, &golden.f64(key), F32_RUN);
    check("cam/from_fov_640x480", &rows(&|lens| *lens));
    check("cam/hfov", &lenses.iter().map(Intrinsics::hfov).collect::<Vec<_>>());
    check("cam/vfov", &lenses.iter().map(Intrinsics::vfov).collect::<Vec<_>>());
    check("cam/K", &lenses.iter().flat_map(|lens| lens.matrix().transpose().to_cols_array()).collect::<Vec<_>>());
    check("cam/crop_m160_0", &rows(&|lens| lens.crop(80, 0, 480, 480)));
    check("cam/scale_0.5", &rows(&|lens| lens.resized(320, 240)));
    check("cam/scale_xy", &rows(&|lens| lens.resized(160, 960)));
    check("cam/predictor_252", &rows(&|lens| lens.crop(80, 0, 480, 480).resized(252, 252)));
}

#[test]
fn priors_are_encoded_as_the_reference_does() {
    let golden = goldens();
    let lenses = golden.f64("prior/camera");
    let poses = poses(&golden, "pose/data");
    let cameras: Vec<Camera> =
        (lenses.chunks(6).zip(poses)).map(|(lens, pose)| Camera { intrinsics: intrinsics(lens), pose }).collect();
    let found = prior_encoding(&cameras).unwrap();
    assert_close("prior/encoding", found.as_flattened(), &golden.f32("prior/encoding"), F32_RUN);
}

#[test]
fn orbits_follow_the_reference() {
    let golden = goldens();
    let center = DVec3::from_slice(&golden.f64("orbit/center"));
    let orbit = Orbit { center, radius: golden.f64("orbit/radius")[0] };
    let angles = golden.f64("orbit/az").into_iter().zip(golden.f64("orbit/el"));
    for ((azimuth, elevation), truth) in angles.zip(poses(&golden, "orbit/pose")) {
        // The f32 reference divides by the cosine, and branches at the poles.
        let steepness = elevation.to_radians().cos();
        let allowed = if steepness < 1e-6 { 1e-6 } else { (1e-7 / steepness).max(1e-6) };
        let found = orbit.pose(azimuth, elevation);
        assert!(found.matrix().abs_diff_eq(truth.matrix(), allowed), "{azimuth}, {elevation}: {found:?}, {truth:?}");
    }

    let orbit = Orbit { center, radius: 2.0 };
    let sweep = orbit.sweep(9, 5.0, 360.0, 10.0);
    assert_close("orbit/poses_sweep", &scenes::pose_rows(&sweep), &golden.f64("orbit/poses_sweep"), F32_RUN);
    let wiggle = orbit.wiggle(9, 16.0, 2.0);
    assert_close("orbit/poses_wiggle", &scenes::pose_rows(&wiggle), &golden.f64("orbit/poses_wiggle"), F32_RUN);
    assert_eq!(orbit.sweep(1, 30.0, 360.0, 0.0), [orbit.pose(30.0, 0.0)]);
    assert!(orbit.sweep(0, 0.0, 360.0, 0.0).is_empty());

    for parity in ["even", "odd"] {
        let means: Vec<[f32; 3]> =
            golden.f32(&format!("orbit/means_{parity}")).chunks(3).map(|mean| [mean[0], mean[1], mean[2]]).collect();
        let found = Orbit::around(&Scene { means, ..Scene::default() }).unwrap();
        let key = format!("orbit/scene_center_{parity}");
        assert_close(&key, &found.center.to_array(), &golden.f64(&key), Tolerance::STORED);
        let key = format!("orbit/scene_radius_{parity}");
        assert_close(&key, &[found.radius], &golden.f64(&key), F32_RUN);
    }
    assert!(matches!(Orbit::around(&Scene::default()), Err(Error::Argument { .. })));
}

#[test]
fn unusable_cameras_are_named_by_index_and_field() {
    type Spoil = fn(&mut Camera);
    let spoils: [(&str, Spoil); 9] = [
        ("size", |camera| camera.intrinsics.width = 0),
        ("fx", |camera| camera.intrinsics.fx = 0.0),
        ("fx", |camera| camera.intrinsics.fx = f64::NAN),
        ("fy", |camera| camera.intrinsics.fy = -3.0),
        ("principal point", |camera| camera.intrinsics.cy = f64::INFINITY),
        ("translation", |camera| camera.pose.translation.z = f64::NAN),
        ("rotation", |camera| camera.pose.rotation.x_axis.x = f64::NAN),
        ("rotation", |camera| camera.pose.rotation *= 1.01),
        ("rotation", |camera| camera.pose.rotation.z_axis *= -1.0),
    ];
    assert!(prior_encoding(&[camera(); 2]).is_ok());
    for (field, spoil) in spoils {
        let mut cameras = [camera(); 3];
        spoil(&mut cameras[1]);
        match prior_encoding(&cameras) {
            Err(Error::Argument { what, .. }) => assert_eq!(what, format!("camera 1, {field}")),
            other => panic!("{field}: {other:?}"),
        }
    }
}
