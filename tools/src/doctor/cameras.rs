//! Known cameras as the camera encoder takes them; made on the host.

use super::{Area, Case, Mode, Worst, bound::U};
use glam::{DMat3, DVec3};
use std::f64::consts::{FRAC_PI_2, PI};
use zipsplat::{
    Result,
    types::{Camera, Intrinsics, Pose, prior_encoding},
};
use zipsplat_reference::backbone::camera_encoder::{Prior, encode};

const REASON: &str = "computed in f64 and rounded to f32 once, which moves a value by its unit roundoff; f64 adds 1e-14 of the \
    camera's distance";

fn check(cameras: &[Camera]) -> Result<Worst> {
    let encoded = prior_encoding(cameras)?;
    let mut worst = Worst::NONE;
    for (camera, got) in cameras.iter().zip(&encoded) {
        let (i, t) = (&camera.intrinsics, camera.pose.translation);
        let r = camera.pose.rotation.transpose().to_cols_array();
        let mut pose = [0.0; 12];
        pose[..9].copy_from_slice(&r);
        pose[9..].copy_from_slice(&t.to_array());
        let camera = [f64::from(i.width), f64::from(i.height), i.fx, i.fy, i.cx, i.cy];
        let truth = encode(&Prior { camera, pose });
        // Of a half turn's quaternion, whose w is 0, either sign is right.
        let turned = got[3..7].iter().zip(&truth[3..7]).map(|(&a, b)| f64::from(a) * b).sum::<f64>() < 0.0;
        let sign = if turned && got[6].abs() < 1e-6 { -1.0 } else { 1.0 };
        for (c, (&got, truth)) in got.iter().zip(truth).enumerate() {
            let truth = if (3..7).contains(&c) { sign * truth } else { truth };
            worst = worst.or(Worst::one(got.into(), truth, U * truth.abs() + 1e-14 * (1.0 + t.length())));
        }
    }
    Ok(worst)
}

fn camera(rotation: DMat3, translation: DVec3, degrees: f64) -> Camera {
    let fov = degrees.to_radians();
    Camera { intrinsics: Intrinsics::from_fov(640, 480, fov, fov), pose: Pose { rotation, translation } }
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, cameras: Vec<Camera>| {
        cases.push(Case::new(name, cameras.len(), move |_, _| check(&cameras)));
    };
    let axes = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::ONE.normalize(), DVec3::new(1.0, -1e-9, 0.0).normalize()];
    let turns = |angles: &[f64]| {
        let turn =
            |&axis: &DVec3| angles.iter().map(move |&angle| DMat3::from_axis_angle(axis, angle)).collect::<Vec<_>>();
        axes.iter().flat_map(turn).map(|r| camera(r, DVec3::new(0.3, -1.0, 2.0), 60.0)).collect::<Vec<_>>()
    };
    add("rotations of 0", turns(&[0.0, 1e-9, -1e-4]));
    add("rotations of 180 degrees", turns(&[PI, PI - 1e-9, PI + 1e-9, PI - 1e-4, PI + 1e-4]));
    add("rotations of 90 and 120 degrees", turns(&[FRAC_PI_2, -FRAC_PI_2, 2.0 * PI / 3.0]));
    add("every sign of a quaternion", turns(&(0..24).map(|i| f64::from(i) * PI / 6.0 - 2.0 * PI).collect::<Vec<_>>()));
    let still = |degrees: f64| camera(DMat3::IDENTITY, DVec3::ZERO, degrees);
    add("fields of view of 1 to 179 degrees", (1..180).map(|d| still(f64::from(d))).collect());
    let mut outside = still(60.0);
    (outside.intrinsics.cx, outside.intrinsics.cy) = (-900.0, 5_000.0);
    add("principal point outside", vec![outside]);
    add("identical poses", vec![still(50.0); 5]);
    let apart =
        |length: f64| move |i: i32| camera(DMat3::from_rotation_y(0.1), DVec3::X * (length * f64::from(i)), 60.0);
    add("cameras in a line", (0..9).map(apart(1.0)).collect());
    add("baselines of 1e-6", (0..3).map(apart(1e-6)).collect());
    add("baselines of 1e6", (0..3).map(apart(1e6)).collect());
    Area { kernel: "camera encoding", size: "cameras", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
