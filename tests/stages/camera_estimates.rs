use glam::DVec2;
use zipsplat::reconstruct::Patches;
use zipsplat::{cameras::CameraEstimate, stages::ViewGrid};
use zipsplat_tests::prelude::*;

const GRID: ViewGrid = ViewGrid { views: 4, rows: 18, columns: 20, patch_size: 14 };

/// A wall, or a ball before a wall and a floor.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Place {
    Wall,
    Room,
}

impl Place {
    fn hit(self, from: DVec3, along: DVec3) -> DVec3 {
        let plane = |normal: DVec3, at: f64| Some((at - normal.dot(from)) / normal.dot(along)).filter(|t| *t > 0.0);
        let wall = plane(DVec3::new(0.3, 0.1, 1.0), 6.0);
        let floor = plane(DVec3::Y, 1.2).filter(|_| self == Self::Room);
        let (way, radius) = (from - DVec3::new(0.2, 0.1, 3.2), 0.9);
        let (b, c) = (way.dot(along), way.length_squared() - radius * radius);
        let ball = Some(b * b - along.length_squared() * c).filter(|d| *d > 0.0 && self == Self::Room);
        let ball = ball.map(|d| (-b - d.sqrt()) / along.length_squared());
        from + along * [wall, floor, ball].into_iter().flatten().fold(f64::INFINITY, f64::min)
    }
}

/// Of 62 degrees; the first is the world frame.
fn cameras() -> Vec<Camera> {
    let [width, height] = [GRID.columns, GRID.rows].map(|count| (count * GRID.patch_size) as u32);
    let focal = 233.0;
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let at = |(turn, translation): ([f64; 3], [f64; 3])| {
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(turn.into()));
        let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx, cy };
        Camera { intrinsics, pose: Pose { rotation, translation: translation.into() } }
    };
    [
        ([0.0; 3], [0.0; 3]),
        ([0.1, -0.35, 0.05], [1.2, -0.2, 0.3]),
        ([-0.1, 0.4, 0.0], [-1.3, 0.3, 0.2]),
        ([0.15, 0.1, 0.4], [0.1, -0.6, 0.8]),
    ]
    .map(at)
    .to_vec()
}

/// One per token at its patch's center, one unseen.
fn decoded(place: Place, patches: &Patches) -> Scene {
    let cameras = cameras();
    let mut scene = Scene { sh_degree: 0, ..Scene::default() };
    for token in 0..patches.len() {
        let (view, DVec2 { x, y }) = patches.patch(token);
        let Camera { intrinsics: lens, pose } = cameras[view];
        let along = pose.rotation * DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0);
        let point = place.hit(pose.translation, along).as_vec3().to_array();
        scene.means.extend([point, [9.0, 9.0, 9.0]]);
        scene.opacities.extend([0.7, 0.0]);
    }
    let count = scene.means.len();
    scene.scales = vec![[0.01; 3]; count];
    scene.quats = vec![[1.0, 0.0, 0.0, 0.0]; count];
    scene.sh_coeffs = vec![[0.0; 3]; count];
    scene
}

/// Medians in degrees and distance.
fn errors(found: &[CameraEstimate]) -> [f64; 2] {
    let of = |(found, truth): (&CameraEstimate, &Camera)| {
        let turn = DQuat::from_mat3(&(found.camera.pose.rotation.transpose() * truth.pose.rotation)).to_scaled_axis();
        [turn.length().to_degrees(), found.camera.pose.translation.distance(truth.pose.translation)]
    };
    let all: Vec<[f64; 2]> = found.iter().zip(&cameras()).map(of).collect();
    [0, 1].map(|i| {
        let mut values: Vec<f64> = all.iter().map(|errors| errors[i]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    })
}

fn estimate(patches: &Patches, scene: &Scene, focal: Option<f64>) -> Vec<CameraEstimate> {
    let found = patches.cameras(scene, focal).expect("a scene of these tokens");
    found.into_iter().map(|found| found.expect("a camera")).collect()
}

#[test]
fn exact_depth_gives_the_cameras() {
    let six: Vec<u32> = (0..4).flat_map(|view| [3, 58, 111, 190, 275, 341].map(|patch| 360 * view + patch)).collect();
    let fifth: Vec<u32> = (0..1440).filter(|token| token % 5 == 2).collect();
    for place in [Place::Room, Place::Wall] {
        for kept in [None, Some(fifth.clone()), Some(six.clone())] {
            let patches = Patches::new(GRID, kept);
            let scene = decoded(place, &patches);
            for focal in [Some(233.0), None] {
                let found = estimate(&patches, &scene, focal);
                let [turn, shift] = errors(&found);
                let case = format!("{place:?}, {} tokens, {focal:?}", patches.len());
                assert!(turn < 0.1 && shift < 0.01, "{turn} degrees, {shift}: {case}");
                for CameraEstimate { camera, inliers, pairs } in found {
                    assert!((camera.intrinsics.fx / 233.0 - 1.0).abs() < 0.01, "{camera:?}: {case}");
                    assert_eq!((inliers, pairs), (patches.len() / 4, patches.len() / 4), "{case}");
                }
            }
        }
    }
}

#[test]
fn half_of_the_tokens_may_be_elsewhere() {
    let patches = Patches::new(GRID, None);
    for place in [Place::Room, Place::Wall] {
        let mut scene = decoded(place, &patches);
        for (i, mean) in scene.means.iter_mut().enumerate().filter(|(i, _)| i % 4 == 0) {
            let number = |k: usize| ((i * 7919 + k * 104_729) % 1000) as f32 / 250.0 - 2.0;
            *mean = [number(1), number(2), 2.0 + number(3)];
        }
        for focal in [Some(233.0), None] {
            let found = estimate(&patches, &scene, focal);
            let [turn, shift] = errors(&found);
            assert!(turn < 0.1 && shift < 0.01, "{turn} degrees, {shift}: {place:?}, {focal:?}");
            assert!(found.iter().all(|found| (180..230).contains(&found.inliers) && found.pairs == 360), "{found:?}");
        }
    }
}

#[test]
fn a_view_without_tokens_has_no_camera() {
    let patches = Patches::new(GRID, Some((0..360).chain([400, 500]).collect()));
    let scene = decoded(Place::Room, &patches);
    let found = patches.cameras(&scene, None).expect("a scene of these tokens");
    assert!(found[0].as_ref().is_ok_and(|found| found.pairs == 360));
    for (view, count) in [(1, 2), (2, 0), (3, 0)] {
        let error = found[view].as_ref().expect_err("too few").to_string();
        assert!(error.contains(&format!("found {count}")) && error.contains("6 or more"), "{error}");
    }
    let mut other = scene.clone();
    other.means.pop();
    assert_refused(patches.cameras(&other, None), &["723", "362 tokens"]);
}

#[test]
fn known_cameras_are_not_estimated() {
    let model = networks::model("micro", Arithmetic::EXACT);
    let photos = [0, 1, 2].map(|i| noise(56, 42, i));
    let cameras = Some(vec![camera(56, 42); 3]);
    let posed = reconstruct(&model, &photos, &ReconstructOptions { cameras, ..ReconstructOptions::default() });
    assert_refused(posed.cameras(&posed.to_scene().expect("Gaussians"), None), &["without cameras"]);
}
