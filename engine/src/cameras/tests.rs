use super::*;
use glam::{DMat3, DQuat, EulerRot};

const FOCAL: f64 = 210.0;

fn seen(random: &mut Random, count: usize, planar: bool) -> (Camera, Vec<Correspondence>) {
    let mut number = |range: f64| range * (2.0 * random.unit() - 1.0);
    let rotation = DMat3::from_quat(DQuat::from_euler(EulerRot::XYZ, number(3.0), number(1.5), number(3.0)));
    let pose = Pose { rotation, translation: DVec3::new(number(5.0), number(5.0), number(5.0)) };
    let intrinsics = Intrinsics { width: 252, height: 252, fx: FOCAL, fy: FOCAL, cx: 126.0, cy: 126.0 };
    let pairs = (0..count).map(|_| {
        let pixel = DVec2::new(126.0 + number(126.0), 126.0 + number(126.0));
        let (x, y) = ((pixel.x - 126.0) / FOCAL, (pixel.y - 126.0) / FOCAL);
        let depth = if planar { 2.0 / (1.0 + 0.5 * x - 0.4 * y) } else { 2.0 + number(1.0) };
        Correspondence { point: pose.transform(depth * DVec3::new(x, y, 1.0)), pixel }
    });
    (Camera { intrinsics, pose }, pairs.collect())
}

/// Degrees, center distance, focal length ratio.
fn errors(found: &Camera, truth: &Camera) -> [f64; 3] {
    let turn = DQuat::from_mat3(&(found.pose.rotation.transpose() * truth.pose.rotation)).to_scaled_axis().length();
    let away = found.pose.translation.distance(truth.pose.translation);
    [turn.to_degrees(), away, found.intrinsics.fx / truth.intrinsics.fx]
}

fn search(focal: Option<f64>, seed: u64) -> RansacOptions {
    RansacOptions { tolerance: 7.0, focal, seed }
}

#[test]
fn exact_pairs_give_the_camera() {
    for (count, planar) in [(300, false), (300, true), (12, false), (MIN_CORRESPONDENCES, false)] {
        for focal in [Some(FOCAL), None] {
            for seed in 0..8 {
                let (truth, pairs) = seen(&mut Random::new(100 + seed), count, planar);
                let found = find_camera(&pairs, [252; 2], &search(focal, seed)).expect("a camera");
                let [turn, away, focal_ratio] = errors(&found.camera, &truth);
                let case = format!("{count} pairs, planar {planar}, focal {focal:?}, seed {seed}");
                assert!(turn < 0.01 && away < 1e-3, "{turn} degrees, {away} away, focal {focal_ratio}: {case}");
                assert!((focal_ratio - 1.0).abs() < 1e-3, "{focal_ratio}: {case}");
                assert_eq!((found.inliers, found.pairs), (count, count), "{case}");
            }
        }
    }
}

#[test]
fn half_of_the_pairs_may_be_wrong() {
    for (planar, focal) in [(false, Some(FOCAL)), (true, Some(FOCAL)), (false, None)] {
        for seed in 0..8 {
            let mut random = Random::new(200 + seed);
            let (truth, mut pairs) = seen(&mut random, 300, planar);
            for pair in pairs.iter_mut().take(150) {
                pair.pixel = DVec2::new(252.0 * random.unit(), 252.0 * random.unit());
            }
            for pair in &mut pairs {
                pair.pixel += DVec2::new(random.normal(), random.normal());
            }
            let found = find_camera(&pairs, [252; 2], &search(focal, seed)).expect("a camera");
            let [turn, away, ratio] = errors(&found.camera, &truth);
            assert!(
                turn < 1.0 && away < 0.1 && (ratio - 1.0).abs() < 0.05,
                "{turn} degrees, {away} away, {ratio}, {planar} {focal:?}"
            );
            assert!((148..170).contains(&found.inliers), "{} inliers", found.inliers);
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let (_, pairs) = seen(&mut Random::new(7), 100, false);
    let found = |seed| find_camera(&pairs, [252; 2], &search(None, seed)).expect("a camera");
    assert_eq!(found(3), found(3));
}

#[test]
fn without_a_camera_the_error_says_how_many_agree() {
    let words =
        |pairs: &[Correspondence]| find_camera(pairs, [252; 2], &search(Some(FOCAL), 0)).unwrap_err().to_string();
    let mut random = Random::new(9);
    let (_, pairs) = seen(&mut random, 5, false);
    for count in [0, 5] {
        let text = words(&pairs[..count]);
        assert!(text.contains(&format!("found {count}")) && text.contains("6 or more"), "{text}");
    }
    let mut number = || 100.0 * random.normal();
    let wrong: Vec<Correspondence> = (0..20)
        .map(|_| Correspondence {
            point: DVec3::new(number(), number(), number()),
            pixel: DVec2::new(126.0 + number(), 126.0 + number()),
        })
        .collect();
    let text = words(&wrong);
    assert!(text.contains("points that agree on a camera") && text.contains("of 20"), "{text}");
    for (focal, tolerance) in [(Some(0.0), 7.0), (Some(f64::NAN), 7.0), (None, -1.0), (None, f64::INFINITY)] {
        let error =
            find_camera(&pairs, [252; 2], &RansacOptions { tolerance, focal, seed: 0 }).unwrap_err().to_string();
        assert!(error.contains("of a camera") && error.contains("above 0"), "{error}");
    }
    let same = [Correspondence { point: DVec3::ONE, pixel: DVec2::ZERO }; 20];
    words(&same);
}
