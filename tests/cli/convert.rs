use crate::Folder;
use zipsplat::ops::{Arithmetic, Precision};
use zipsplat::types::{Scene, write_ply};
use zipsplat::weights::Checkpoint;
use zipsplat_tests::{device::device, scenes};

#[test]
fn a_round_trip_keeps_every_value() {
    let folder = Folder::new();
    // Seeded values fit the short types.
    for dtype in ["f32", "f16", "bf16"] {
        folder.run(&format!("convert @/micro.safetensors @/{dtype}.safetensors --dtype {dtype}")).success();
        folder.run(&format!("convert @/{dtype}.safetensors @/back.safetensors --dtype f32")).success();
        assert_eq!(folder.read("back.safetensors"), folder.read("micro.safetensors"), "{dtype}");
        let checkpoint = Checkpoint::open(folder.path(&format!("{dtype}.safetensors")), None).expect("it names itself");
        assert_eq!(checkpoint.architecture().name, "micro");
    }
    let size = |name: &str| folder.path(name).metadata().expect("a file").len();
    assert!(size("f16.safetensors") < size("f32.safetensors") * 6 / 10);
}

#[test]
fn weights_of_8_bits_go_through_every_command() {
    let folder = Folder::new();
    let json = folder.run("convert @/micro.safetensors @/q8.safetensors --dtype q8 --json").json();
    let size = |name: &str| folder.path(name).metadata().expect("a file").len();
    assert_eq!((&json["dtype"], json["bytes"].as_u64()), (&"q8".into(), Some(size("q8.safetensors"))));
    assert!(size("q8.safetensors") < size("micro.safetensors") * 2 / 3);
    folder.run("convert @/q8.safetensors @/again.safetensors --dtype q8").success();
    assert_eq!(folder.read("again.safetensors"), folder.read("q8.safetensors"));
    let info = folder.run("convert @/q8.safetensors --json").json();
    let stored = info["stored"].as_object().expect("bytes of each type");
    assert_eq!(stored.keys().collect::<Vec<_>>(), ["f16", "f32", "q8"]);
    assert!(folder.run("convert @/q8.safetensors").success().contains("q8 "));
    let plan = |weights: &str| {
        let plan = folder
            .run(&format!("--device none reconstruct --dry-run --weights @/{weights}.safetensors --views 2 --json"));
        plan.json()["weight_bytes"].as_u64().expect("bytes")
    };
    assert!(plan("q8") < plan("micro") * 4 / 5, "{} of {}", plan("q8"), plan("micro"));
    if Arithmetic::of(Precision::Int8, device().limits()).is_some() {
        let int8 = folder.run("reconstruct --dry-run --weights @/q8.safetensors --views 2 --precision int8");
        int8.fails(3, &["q8.safetensors, whose weights are q8", "fp32, fp16 or bf16"]);
    }
    folder.run("convert @/micro.safetensors @/b.safetensors --dtype q9").fails(3, &["dtype", "q9", "bf16 or q8"]);
}

#[test]
fn json_tells_what_was_written() {
    let folder = Folder::new();
    let json = folder.run("convert @/micro.safetensors @/out.safetensors --dtype bf16 --json").json();
    assert_eq!(json["bytes"].as_u64(), Some(folder.path("out.safetensors").metadata().expect("a file").len()));
    assert_eq!((&json["dtype"], &json["architecture"]["width"]), (&"bf16".into(), &64.into()));
}

#[test]
fn scenes_go_from_format_to_format() {
    let folder = Folder::new();
    let truth = scenes::random_scene(30, 1, 0.1);
    write_ply(&truth, folder.path("a.ply")).expect("a scene can be written");
    for (from, to, degree) in [
        ("a.ply", "b.spz", 1),
        ("b.spz", "c.glb", 1),
        ("c.glb", "d.gltf", 1),
        ("d.gltf", "e.splat", 0),
        ("e.splat", "f.ply", 0),
    ] {
        let outcome = folder.run(&format!("convert @/{from} @/{to} --json"));
        assert_eq!(outcome.err.contains("one color"), to == "e.splat", "{}", outcome.err);
        let json = outcome.json();
        assert_eq!(json["bytes"].as_u64(), Some(folder.path(to).metadata().expect("a file").len()), "{to}");
        let scene = Scene::open(folder.path(to)).expect("a scene");
        assert_eq!((scene.len(), scene.sh_degree), (30, degree), "{to}");
        let info = folder.run(&format!("convert @/{to} --json")).json();
        assert_eq!((&info["gaussians"], &info["sh_degree"]), (&30.into(), &degree.into()));
    }
    folder.run("convert @/a.ply @/two.spz --spz-version 2").success();
    assert!(folder.read("two.spz").len() < folder.read("b.spz").len());
    folder.run("convert @/a.ply @/four.spz --spz-version 4").success();
    assert!(folder.read("four.spz").starts_with(b"NGSP\x04"));
    folder.run("convert @/four.spz @/g.ply").success();
    let [three, four] = ["b.spz", "four.spz"].map(|name| Scene::open(folder.path(name)).expect("a scene"));
    assert!(three == four);
    let mut found = Scene::open(folder.path("f.ply")).expect("a scene").means;
    let mut means = truth.means;
    found.sort_by(|a, b| a[2].total_cmp(&b[2]));
    means.sort_by(|a, b| a[2].total_cmp(&b[2]));
    let close = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).all(|c| (a[c] - b[c]).abs() < 1e-4);
    assert!(found.iter().zip(&means).all(close));
}

#[test]
fn a_far_gaussian_that_coarsens_an_spz_is_noted() {
    let folder = Folder::new();
    let mut scene = scenes::random_scene(30, 0, 0.1);
    write_ply(&scene, folder.path("near.ply")).expect("a scene can be written");
    scene.means[7] = [0.0, -5000.0, 3.0];
    write_ply(&scene, folder.path("far.ply")).expect("a scene can be written");
    let outcome = folder.run("convert @/near.ply @/near.spz");
    assert!(!outcome.err.contains("note"), "{}", outcome.err);
    let outcome = folder.run("convert @/far.ply @/far.spz");
    let note = "multiples of 9.77e-4, not of 1.53e-5: 1 of 30 Gaussians lie beyond 128 units, the farthest 5000 away";
    assert!(outcome.err.contains(note), "{}", outcome.err);
    let means = Scene::open(folder.path("far.spz")).expect("a scene").means;
    let steps = |value: f32| f64::from(value) * 1024.0;
    assert!(means.iter().flatten().all(|value| steps(*value).fract() == 0.0));
    assert!(means.iter().flatten().any(|value| (steps(*value) / 2.0).fract() != 0.0));
    let outcome = folder.run("convert @/far.ply @/far.glb");
    assert!(!outcome.err.contains("note"), "{}", outcome.err);
}

#[test]
fn what_does_not_fit_is_refused() {
    let folder = Folder::new();
    folder.scatter("a.ply", 3, 0, 0.1);
    let before = folder.names();
    for (line, words) in [
        ("@/a.ply @/b.safetensors", ["output of a scene", ".spz"]),
        ("@/micro.safetensors @/b.ply", ["micro.safetensors", "no scene"]),
        ("@/a.ply @/b.spz --dtype f16", ["--dtype: found a scene", "expected a checkpoint"]),
        ("@/a.ply @/b.ply --spz-version 3", ["--spz-version", "SPZ"]),
        ("@/micro.safetensors @/b.safetensors --spz-version 3", ["--spz-version", "checkpoint"]),
        ("@/absent.ply @/b.spz", ["absent.ply", "No such file"]),
    ] {
        folder.run(&format!("convert {line}")).fails(3, &words);
    }
    assert_eq!(folder.names(), before);
}
