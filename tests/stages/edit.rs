use glam::{DMat3, DQuat, DVec3};
use zipsplat::{
    Camera, Edit, Edited, Pose, Scene,
    types::{Intrinsics, mean_up, sh_rotation},
};
use zipsplat_tests::scenes::random_scene;

fn edit(name: &str, numbers: &[f64]) -> Edit {
    Edit::new(name, numbers).expect("a valid edit")
}

fn edited(scene: &Scene, edits: &[Edit]) -> Scene {
    scene.edit(edits, &[]).expect("a scene").scene
}

fn centers(scene: &Scene) -> Vec<DVec3> {
    scene.means.iter().map(|mean| DVec3::from(mean.map(f64::from))).collect()
}

fn of(scene: &Scene, sources: &[usize]) -> Scene {
    let mut found = scene.clone();
    found.keep(sources);
    found
}

fn kept(scene: &Scene, hold: impl Fn(usize) -> bool) -> Scene {
    let kept = of(scene, &(0..scene.len()).filter(|i| hold(*i)).collect::<Vec<_>>());
    assert!(!kept.is_empty() && kept.len() < scene.len(), "{} of {}", kept.len(), scene.len());
    kept
}

fn camera(at: DVec3, turn: f64) -> Camera {
    let pose = Pose { rotation: DMat3::from_rotation_y(turn), translation: at };
    Camera { intrinsics: Intrinsics::from_fov(64, 48, 0.9, 0.7), pose }
}

#[test]
fn selections_keep_exactly_the_gaussians_that_fulfill_them() {
    let scene = random_scene(500, 1, 0.3);
    let at = centers(&scene);
    let largest = |i: usize| f64::from(scene.scales[i].into_iter().fold(0.0, f32::max));
    let near = |i: usize| at.iter().filter(|other| other.distance(at[i]) <= 0.4).count() - 1;
    let cameras = [camera(DVec3::ZERO, 0.0), camera(DVec3::new(0.5, 0.0, 0.0), 0.2), camera(DVec3::ZERO, -0.4)];
    let seen = |i: usize| cameras.iter().filter(|camera| camera.project(at[i]).is_some()).count();
    let cases = [
        (
            edit("crop-box", &[-1.0, -0.5, 1.5, 1.0, 2.0, 4.0]),
            kept(&scene, |i| {
                let DVec3 { x, y, z } = at[i];
                (-1.0..=1.0).contains(&x) && (-0.5..=2.0).contains(&y) && (1.5..=4.0).contains(&z)
            }),
        ),
        (
            edit("crop-sphere", &[0.5, 0.0, 3.0, 1.5]),
            kept(&scene, |i| at[i].distance(DVec3::new(0.5, 0.0, 3.0)) <= 1.5),
        ),
        (edit("min-opacity", &[0.25]), kept(&scene, |i| scene.opacities[i] >= 0.25)),
        (edit("max-size", &[0.1]), kept(&scene, |i| largest(i) <= 0.1)),
        (edit("min-neighbors", &[3.0, 0.4]), kept(&scene, |i| near(i) >= 3)),
        (edit("min-views", &[2.0]), kept(&scene, |i| seen(i) >= 2)),
    ];
    for (edit, expected) in cases {
        let Edited { scene: found, sources, reports } = scene.edit(&[edit], &cameras).expect("a scene");
        assert_eq!(found, expected, "{}", edit.name());
        assert_eq!(of(&scene, &sources), expected, "{}", edit.name());
        let [report] = &reports[..] else { panic!("{reports:?}") };
        assert_eq!((report.edit, report.before, report.after), (edit.name(), 500, expected.len()));
        assert!(report.effect.starts_with(&format!("{} ", 500 - expected.len())), "{}", report.effect);
    }
}

#[test]
fn edits_apply_in_order_and_move_the_cameras_too() {
    let scene = random_scene(300, 2, 0.1);
    let (grow, cut) = (edit("scale", &[2.0]), edit("max-size", &[0.05]));
    assert_eq!(edited(&scene, &[grow, cut]).len(), edited(&scene, &[edit("max-size", &[0.025])]).len());
    assert!(edited(&scene, &[cut, grow]).len() > edited(&scene, &[grow, cut]).len());
    let cameras = [camera(DVec3::new(0.3, 0.1, 0.0), 0.3)];
    let (moves, views) =
        ([edit("translate", &[1.0, 2.0, 3.0]), edit("rotate", &[10.0, 20.0, 30.0]), grow], edit("min-views", &[1.0]));
    let first = scene.edit(&[&[views], &moves[..]].concat(), &cameras).expect("a scene").scene;
    let last = scene.edit(&[&moves[..], &[views]].concat(), &cameras).expect("a scene").scene;
    assert_eq!(first, last);
    assert!(first.len() < scene.len());
}

#[test]
fn placements_rotate_everything_about_the_origin() {
    let scene = random_scene(20, 3, 0.1);
    let turned = edited(&scene, &[edit("rotate", &[90.0, 0.0, 0.0]), edit("rotate", &[0.0, 90.0, 0.0])]);
    assert_eq!(turned.opacities, scene.opacities);
    let rotation = DMat3::from_rotation_y(90f64.to_radians()) * DMat3::from_rotation_x(90f64.to_radians());
    let harmonics = sh_rotation(&rotation);
    for i in 0..20 {
        let (before, after) = (centers(&scene)[i], centers(&turned)[i]);
        assert!((rotation * before).distance(after) < 1e-5);
        let red = |scene: &Scene, k: usize| f64::from(scene.sh_coeffs[16 * i + k][0]);
        for (k, row) in harmonics.iter().enumerate() {
            let expected: f64 = row.iter().enumerate().map(|(j, factor)| factor * red(&scene, j)).sum();
            assert!((red(&turned, k) - expected).abs() < 1e-5);
        }
    }
    let steps =
        [edit("rotate", &[20.0, 0.0, 0.0]), edit("rotate", &[0.0, 30.0, 0.0]), edit("rotate", &[0.0, 0.0, 40.0])];
    let (one, three) = (edited(&scene, &[edit("rotate", &[20.0, 30.0, 40.0])]), edited(&scene, &steps));
    assert!(centers(&one).into_iter().zip(centers(&three)).all(|(a, b)| a.distance(b) < 1e-5));
}

#[test]
fn level_turns_the_cameras_mean_up_to_minus_y() {
    let scene = random_scene(20, 1, 0.1);
    let tilt = DMat3::from_rotation_z(0.5) * DMat3::from_rotation_x(0.3);
    let cameras: Vec<Camera> = (0..6)
        .map(|i| {
            let pose = Pose { rotation: tilt * DMat3::from_rotation_y(f64::from(i)), translation: tilt.z_axis };
            Camera { pose, ..camera(DVec3::ZERO, 0.0) }
        })
        .collect();
    let up = mean_up(&cameras).expect("an up");
    let level = scene.edit(&[edit("level", &[])], &cameras).expect("a scene").scene;
    let turn = DQuat::from_rotation_arc(up, DVec3::NEG_Y);
    for (before, after) in centers(&scene).into_iter().zip(centers(&level)) {
        assert!((turn * before).distance(after) < 1e-5);
        assert!((before.dot(up) + after.y).abs() < 1e-5);
    }
    let error = scene.edit(&[edit("level", &[])], &[]).expect_err("no cameras").to_string();
    assert!(error.contains("level") && error.contains("no cameras"), "{error}");
}

#[test]
fn degrees_are_lowered_and_gaussians_sorted() {
    let scene = random_scene(50, 2, 0.1);
    let low = edited(&scene, &[edit("sh-degree", &[1.0])]);
    assert_eq!((low.sh_degree, low.sh_coeffs.len()), (1, 200));
    assert!((0..50).all(|i| low.sh_coeffs[4 * i..][..4] == scene.sh_coeffs[9 * i..][..4]));
    assert_eq!(edited(&low, &[edit("sh-degree", &[3.0])]), low);
    let sorted = edited(&scene, &[edit("sort", &[])]);
    let visibility = |i: usize| {
        let mut scales = sorted.scales[i];
        scales.sort_by(f32::total_cmp);
        sorted.opacities[i] * scales[1] * scales[2]
    };
    assert!((1..50).all(|i| visibility(i - 1) >= visibility(i)));
    let mut opacities = [sorted.opacities, scene.opacities];
    opacities.iter_mut().for_each(|opacities| opacities.sort_by(f32::total_cmp));
    assert_eq!(opacities[0], opacities[1]);
}

#[test]
fn merged_gaussians_have_the_mean_and_covariance_of_their_pair() {
    let pair = Scene {
        means: vec![[-0.5, 0.0, 3.0], [0.5, 0.0, 3.0]],
        scales: vec![[0.5, 0.4, 0.1]; 2],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        opacities: vec![0.4, 0.4],
        sh_coeffs: vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        ..Scene::default()
    };
    let one = edited(&pair, &[edit("decimate", &[1.0])]);
    assert_eq!((one.len(), one.means[0], one.sh_coeffs[0]), (1, [0.0, 0.0, 3.0], [0.5, 0.5, 0.0]));
    let mut scales = one.scales[0];
    scales.sort_by(f32::total_cmp);
    for (found, expected) in scales.into_iter().zip([0.1, 0.4, 0.5f32.sqrt()]) {
        assert!((found - expected).abs() < 1e-6, "{scales:?}");
    }
    let area = 2.0 * 0.4 * 0.5 * 0.4 / (0.4 * 0.5f32.sqrt());
    assert!((one.opacities[0] - area).abs() < 1e-6, "{}", one.opacities[0]);
    // Two at one place.
    let same = Scene { means: vec![[0.0; 3]; 2], ..pair };
    let one = edited(&same, &[edit("decimate", &[0.5])]);
    assert!((one.opacities[0] - 0.64).abs() < 1e-6, "{}", one.opacities[0]);
}

#[test]
fn decimation_merges_near_gaussians_of_one_color() {
    let scene = Scene {
        means: [9.0, 1.0, 0.0, -1.0].map(|x| [x, 0.0, 3.0]).to_vec(),
        scales: vec![[0.5; 3]; 4],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 4],
        opacities: vec![0.4; 4],
        sh_coeffs: vec![[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        ..Scene::default()
    };
    let found = edited(&scene, &[edit("decimate", &[3.0])]);
    assert_eq!(found.means, [9.0, 1.0, -0.5].map(|x| [x, 0.0, 3.0]));
    assert_eq!(found.sh_coeffs, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]);
    let invalid = Scene { opacities: vec![2.0; 4], ..scene };
    let error = invalid.edit(&[edit("min-opacity", &[0.1])], &[]).expect_err("invalid").to_string();
    assert!(error.contains("scene opacities"), "{error}");
}

#[test]
fn decimation_merges_to_the_count_and_repeats_bit_for_bit() {
    let scene = random_scene(1000, 1, 0.2);
    for (number, count) in [(1000.0, 1000), (999.0, 999), (0.25, 250), (7.0, 7), (5000.0, 1000)] {
        let Edited { scene: found, mut sources, reports } =
            scene.edit(&[edit("decimate", &[number])], &[]).expect("a scene");
        sources.sort_unstable();
        sources.dedup();
        assert_eq!(sources.len(), count);
        assert_eq!(found.len(), count);
        assert!(reports[0].effect.starts_with(&format!("{} merged", 1000 - count)), "{}", reports[0].effect);
        assert_eq!(found, edited(&scene, &[edit("decimate", &[number])]));
    }
    // Equal neighbors go first, wherever listed.
    let mut doubled = random_scene(40, 1, 0.05);
    doubled.append(random_scene(40, 1, 0.05));
    let single = edited(&doubled, &[edit("decimate", &[40.0])]);
    let at = |scene: &Scene| scene.means.clone();
    assert_eq!(at(&single), at(&random_scene(40, 1, 0.05)));
    // The most visible of a pair is its source.
    doubled.opacities[..20].iter_mut().for_each(|opacity| *opacity *= 0.99);
    let sorted = doubled.edit(&[edit("decimate", &[40.0]), edit("sort", &[])], &[]).expect("a scene");
    let mut sources = sorted.sources.clone();
    sources.sort_unstable();
    assert_eq!(sources, (20..60).collect::<Vec<_>>());
    assert_eq!(at(&sorted.scene), at(&of(&doubled, &sorted.sources)));
}

#[test]
fn clean_drops_floaters_and_keeps_the_rest() {
    let mut scene = random_scene(2000, 0, 0.3);
    scene.opacities.fill(0.5);
    let [faint, large, alone, behind, beside] = [3, 5, 8, 11, 14];
    scene.opacities[faint] = 0.009;
    scene.scales[large] = [50.0, 0.1, 0.1];
    (scene.means[alone], scene.scales[alone]) = ([0.0, -30.0, 40.0], [0.5, 0.1, 0.1]);
    (scene.means[behind], scene.scales[behind]) = ([0.0, 0.0, -1.0], [2.0; 3]);
    (scene.means[beside], scene.scales[beside]) = ([1.4, 0.0, 2.0], [2.0; 3]);
    let clean = |cameras: &[Camera]| scene.edit(&[edit("clean", &[])], cameras).expect("a scene");
    // 66 degrees: 0.65 of the depth to a side, doubled 1.3.
    let cameras = [Camera::from_hfov_deg(64, 64, 66.0)];
    for (cameras, expected) in
        [(&[][..], [false, true, false, true, true]), (&cameras, [false, true, false, false, true])]
    {
        let Edited { scene: found, reports, .. } = clean(cameras);
        let kept = [faint, large, alone, behind, beside].map(|i| found.means.contains(&scene.means[i]));
        assert_eq!(kept, expected, "{reports:?}");
        assert!(found.len() > 1900, "{reports:?}");
    }
}

#[test]
fn invalid_edits_name_themselves_and_change_nothing() {
    for (name, numbers, words) in [
        ("crop-box", &[0.0; 5][..], &["crop-box", "0,0,0,0,0", "lower and the upper corner"][..]),
        ("crop-box", &[0.0, 0.0, 1.0, 1.0, 1.0, 0.0], &["crop-box", "0,0,1,1,1,0"]),
        ("crop-sphere", &[0.0, 0.0, 0.0, -1.0], &["crop-sphere", "-1"]),
        ("translate", &[0.0, f64::NAN, 0.0], &["translate", "NaN"]),
        ("scale", &[0.0], &["scale", "FACTOR"]),
        ("min-opacity", &[1.5], &["min-opacity", "1.5", "0 to 1"]),
        ("min-views", &[0.5], &["min-views", "0.5"]),
        ("sh-degree", &[4.0], &["sh-degree", "4", "0 to 3"]),
        ("decimate", &[1.5], &["decimate", "1.5", "fraction"]),
        ("clean", &[1.0], &["clean", "no numbers"]),
        ("vanish", &[], &["vanish", "crop-box"]),
    ] {
        let error = Edit::new(name, numbers).expect_err(name).to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
    }
    let scene = random_scene(10, 0, 0.1);
    let error = scene.edit(&[edit("crop-sphere", &[0.0, 0.0, 90.0, 1.0])], &[]).expect_err("empty").to_string();
    assert!(error.contains("crop-sphere") && error.contains("10 outside the sphere"), "{error}");
    scene.edit(&[edit("scale", &[1e300])], &[]).expect_err("infinite positions");
}
