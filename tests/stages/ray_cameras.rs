use zipsplat::cameras::{RayMap, decoded_camera};
use zipsplat_tests::prelude::*;

const GRID: [u32; 2] = [24, 16];

fn map(golden: &Golden, case: &str) -> RayMap {
    let rays = golden.f32(&format!("{case}/ray"));
    let (rays, _) = rays.as_chunks::<6>();
    RayMap {
        width: GRID[0],
        height: GRID[1],
        directions: rays.iter().map(|ray| [ray[0], ray[1], ray[2]]).collect(),
        origins: rays.iter().map(|ray| [ray[3], ray[4], ray[5]]).collect(),
        confidence: golden.f32(&format!("{case}/conf")),
    }
}

fn matrix(values: &[f64]) -> DMat3 {
    DMat3::from_cols_slice(values).transpose()
}

fn degrees(a: DMat3, b: DMat3) -> f64 {
    let turn = a * b.transpose();
    let skew = DVec3::new(turn.y_axis.z - turn.z_axis.y, turn.z_axis.x - turn.x_axis.z, turn.x_axis.y - turn.y_axis.x);
    (skew.length() / 2.0).atan2((turn.x_axis.x + turn.y_axis.y + turn.z_axis.z - 1.0) / 2.0).to_degrees()
}

/// Exact, also with a far principal point; with noise and outliers within a third of a degree.
#[test]
fn rays_give_their_camera() {
    let Some(golden) = Golden::open("da3_rays.safetensors") else { return };
    let cases = golden.stems("/true_R");
    assert!(cases.len() >= 7);
    for case in cases {
        let key = |name: &str| golden.f64(&format!("{case}/{name}"));
        let found = map(&golden, &case).camera([2 * GRID[0], 2 * GRID[1]]).unwrap();
        let (lens, k) = (found.camera.intrinsics, key("true_K"));
        let exact = ["exact", "offcentre"].contains(&case.as_str());
        let off = degrees(found.camera.pose.rotation, matrix(&key("true_R")));
        assert!(off < if exact { 1e-4 } else { 0.35 }, "{case}: off by {off} degrees");
        let [half_width, half_height] = GRID.map(f64::from);
        let lens =
            [lens.fx / half_width, lens.fy / half_height, lens.cx / half_width - 1.0, lens.cy / half_height - 1.0];
        for (found, truth) in lens.iter().zip([k[0], k[4], k[2], k[5]]) {
            assert!((found - truth).abs() < if exact { 1e-5 } else { 1.5e-2 }, "{case}: {lens:?}, truth {k:?}");
        }
        let apart = found.camera.pose.translation - DVec3::from_slice(&key("t"));
        assert!(apart.length() < 5e-3, "{case}: {apart} from the mean of all");
    }
}

#[test]
fn rays_of_no_camera_are_refused() {
    let Some(golden) = Golden::open("da3_rays.safetensors") else { return };
    let good = map(&golden, "front");
    let refused = |map: &RayMap, words: &str| assert_refused(map.camera(GRID), &[words]);
    let mirrored = good.directions.iter().map(|d| [-d[0], d[1], d[2]]).collect();
    refused(&RayMap { directions: mirrored, ..good.clone() }, "mirrored");
    let nonsense =
        (0..good.directions.len()).map(|i| [(i % 7) as f32 - 3.0, (i % 5) as f32 - 2.0, (i % 3) as f32 - 1.0]);
    refused(&RayMap { directions: nonsense.collect(), ..good.clone() }, "rays that agree");
    refused(&RayMap { directions: vec![[0.0; 3]; good.directions.len()], ..good.clone() }, "rays that agree");
    refused(&RayMap { confidence: Vec::new(), ..good.clone() }, "24 x 16 of each");
}

#[test]
fn decoded_cameras() {
    let Some(golden) = Golden::open("da3_units.safetensors") else { return };
    let (encodings, poses, lenses) = (golden.f64("pose/encoding"), golden.f64("pose/c2w"), golden.f64("pose/K_42x56"));
    for ((encoding, pose), k) in encodings.chunks(9).zip(poses.chunks(12)).zip(lenses.chunks(9)) {
        let encoding: [f32; 9] = std::array::from_fn(|i| encoding[i] as f32);
        let camera = decoded_camera(&encoding, [56, 42]);
        let lens = camera.intrinsics;
        for (found, truth) in [lens.fx, lens.fy, lens.cx, lens.cy].iter().zip([k[0], k[4], k[2], k[5]]) {
            assert!((found - truth).abs() < 1e-5 * truth.abs(), "{lens:?}, truth {k:?}");
        }
        let truth = DMat3::from_cols(
            DVec3::new(pose[0], pose[4], pose[8]),
            DVec3::new(pose[1], pose[5], pose[9]),
            DVec3::new(pose[2], pose[6], pose[10]),
        );
        assert!(camera.pose.rotation.abs_diff_eq(truth, 1e-6), "{encoding:?}");
        assert!(camera.pose.translation.abs_diff_eq(DVec3::new(pose[3], pose[7], pose[11]), 1e-6), "{encoding:?}");
    }
    for (rotation, quat) in golden.f64("quat/R").chunks(9).zip(golden.f64("quat/xyzw").chunks(4)) {
        let [x, y, z, w] = std::array::from_fn(|i| quat[i]);
        assert!(matrix_from_quaternion([w, x, y, z]).abs_diff_eq(matrix(rotation), 1e-9), "{quat:?}");
    }
}
