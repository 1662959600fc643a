use crate::Folder;
use zipsplat::types::{Origin, Pose, Scene, World, write_ply};
use zipsplat_tests::scenes;

fn write(folder: &Folder, name: &str, count: usize, degree: u32) -> Scene {
    let scene = scenes::random_scene(count, degree, 0.1);
    write_ply(&scene, folder.path(name)).expect("a scene can be written");
    Scene::open(folder.path(name)).expect("a scene")
}

#[test]
fn edits_apply_in_the_order_given_and_report() {
    let folder = Folder::new();
    let scene = write(&folder, "a.ply", 200, 1);
    let run = |edits: &str| {
        let json = folder.run(&format!("edit @/a.ply {edits} -o @/b.ply --json")).json();
        let scene = Scene::open(folder.path("b.ply")).expect("a scene");
        assert_eq!(
            (json["gaussians"].as_u64(), json["input_gaussians"].as_u64()),
            (Some(scene.len() as u64), Some(200))
        );
        (scene, json)
    };
    let (first, json) = run("--scale 2 --max-size 0.06 --sh-degree 0 --translate -1,0,2.5 --sort");
    let (second, _) = run("--max-size 0.06 --scale 2 --sh-degree 0 --translate -1,0,2.5 --sort");
    assert!(first.len() < second.len() && second.len() < 200, "{} and {}", first.len(), second.len());
    let names: Vec<&str> =
        json["edits"].as_array().expect("edits").iter().filter_map(|edit| edit["edit"].as_str()).collect();
    assert_eq!(names, ["scale", "max-size", "sh-degree", "translate", "sort"]);
    let effect = json["edits"][1]["effect"].as_str().expect("text");
    assert_eq!(effect, format!("{} larger than 0.0600", 200 - first.len()));
    assert_eq!((&json["edits"][1]["before"], &json["edits"][1]["after"]), (&200.into(), &first.len().into()));
    let twice = run("--translate 1,0,0 --scale 2 --translate 0,3,0").0;
    assert!((twice.means[5][0] - 2.0 * (scene.means[5][0] + 1.0)).abs() < 1e-5);
    assert!((twice.means[5][1] - (2.0 * scene.means[5][1] + 3.0)).abs() < 1e-5);
    let text = folder.run("edit @/a.ply --clean --decimate 0.5 -o @/b.ply").success();
    assert!(text.contains("clean") && text.contains("merged into neighbors"), "{text}");
}

#[test]
fn scenes_are_merged_and_keep_a_common_world() {
    let folder = Folder::new();
    let (a, b) = (write(&folder, "a.ply", 30, 1), write(&folder, "b.ply", 20, 0));
    let outcome = folder.run("edit @/a.ply @/b.ply -o @/c.ply");
    assert!(!outcome.err.contains("another world"), "{}", outcome.err);
    let both = Scene::open(folder.path("c.ply")).expect("a scene");
    assert_eq!((both.len(), both.sh_degree), (50, 1));
    assert_eq!([&both.means[..30], &both.means[30..]], [&a.means[..], &b.means[..]]);
    let world = World::from(Origin::Cameras(Pose::IDENTITY));
    a.save_in(folder.path("w.ply"), &Default::default(), Some(&world)).expect("a scene can be written");
    let world_of = |name: &str| zipsplat::types::read_world(folder.path(name)).expect("a file");
    folder.run("edit @/w.ply @/w.ply --min-opacity 0.2 -o @/d.ply").success();
    assert_eq!(world_of("d.ply"), Some(world));
    assert!(folder.run("edit @/w.ply @/a.ply -o @/d.ply").err.contains("another world"));
    assert_eq!(world_of("d.ply"), None);
    folder.run("edit @/w.ply --scale 2 -o @/d.ply").success();
    assert_eq!(world_of("d.ply"), None);
}

#[test]
fn the_antialiased_tag_is_kept_set_and_merged_only_with_itself() {
    let folder = Folder::new();
    write(&folder, "a.ply", 30, 0);
    let antialiased = |name: &str| {
        let json = folder.run(&format!("convert @/{name} --json")).json();
        assert_eq!(json["antialiased"].as_bool(), Some(Scene::open(folder.path(name)).expect("a scene").antialiased));
        json["antialiased"] == true
    };
    folder.run("convert @/a.ply @/b.ply --antialiased").success();
    assert!(!antialiased("a.ply") && antialiased("b.ply"));
    assert!(folder.run("convert @/b.ply").success().contains("degree 0, antialiased"));
    for line in ["convert @/b.ply @/c.spz", "convert @/c.spz @/c.sog", "edit @/c.sog --scale 2 -o @/c.ply"] {
        let outcome = folder.run(line);
        assert!(!outcome.err.contains("antialiased"), "{line}: {}", outcome.err);
        outcome.success();
    }
    assert!(antialiased("c.spz") && antialiased("c.sog") && antialiased("c.ply"));
    assert!(
        folder.run("edit @/b.ply --scale 2 -o @/d.glb").err.contains("d.glb cannot say that the scene is antialiased")
    );
    folder.run("edit @/a.ply @/b.ply -o @/d.ply").fails(3, &["scenes to merge", "antialiased"]);
    folder.run("edit @/a.ply @/b.ply -o @/d.ply --antialiased=false").success();
    folder.run("edit @/b.ply @/b.ply -o @/e.ply").success();
    assert!(!antialiased("d.ply") && antialiased("e.ply"));
    folder.run("convert @/micro.safetensors --antialiased").fails(3, &["--antialiased", "a checkpoint"]);
}

#[test]
fn cameras_select_what_they_see_in_the_scenes_world() {
    let folder = Folder::new();
    write(&folder, "a.ply", 200, 0);
    let cameras = r#"{"fl_x": 40, "fl_y": 40, "cx": 16, "cy": 16, "w": 32, "h": 32, "frames": [{"file_path": "a.png",
        "transform_matrix": [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}]}"#;
    std::fs::write(folder.path("cameras.json"), cameras).expect("a file");
    let (outcome, all) = (folder.run("edit @/a.ply --cameras @/cameras.json --min-views 1 -o @/b.ply"), 200);
    outcome.success();
    let seen = Scene::open(folder.path("b.ply")).expect("a scene");
    let in_view = |[x, y, z]: [f32; 3]| (40.0 * x / z).abs() <= 16.0 && (40.0 * y / z).abs() <= 16.0;
    assert!(seen.len() < all && !seen.is_empty() && seen.means.iter().all(|mean| in_view(*mean)));
    folder.run("edit @/a.ply --min-views 1 -o @/b.ply").fails(3, &["--min-views", "--cameras FILE"]);
    folder.run("edit @/a.ply --level -o @/b.ply").fails(3, &["--level", "--cameras FILE"]);
}

#[test]
fn invalid_edits_leave_no_file() {
    let folder = Folder::new();
    write(&folder, "a.ply", 20, 0);
    for (edits, code, words) in [
        ("", 3, &["edits", "--clean"][..]),
        ("--crop-box 0,0,0,1,1", 2, &["--crop-box", "0,0,0,1,1", "corner"]),
        ("--crop-sphere 0,0,far,1", 2, &["--crop-sphere", "0,0,far,1", "numbers"]),
        ("--decimate 0", 2, &["--decimate", "fraction"]),
        ("--sort --crop-sphere 90,0,0,1", 3, &["crop-sphere", "no Gaussian", "outside the sphere"]),
        ("--scale 1e300", 3, &["means"]),
    ] {
        folder.run(&format!("edit @/a.ply {edits} -o @/b.ply")).fails(code, words);
        assert!(!folder.path("b.ply").exists(), "{edits}");
    }
    folder.run("edit @/a.ply --clean -o @/b.obj").fails(3, &["b.obj", ".ply"]);
}
