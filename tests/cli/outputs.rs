use crate::{Folder, names};
use zipsplat::types::{Image, Scene, poses::write_transforms, write_ply};
use zipsplat_tests::scenes;

fn folder() -> Folder {
    let folder = Folder::new();
    folder.scatter("scene.ply", 50, 1, 0.2);
    folder
}

#[test]
fn every_command_replaces_its_own_files_and_no_others() {
    let folder = folder();
    folder.run("scene --seed 5 --views 4 --size 42x28 -o @/place").success();
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    let small = "--orbit --frames 2 --size 16x16";
    let cases = [
        (format!("reconstruct @/photos {micro} -o @/a.ply"), "a.ply"),
        (format!("reconstruct @/photos {micro} -o @/a.spz"), "a.spz"),
        (format!("reconstruct @/photos {micro} -o @/a.glb"), "a.glb"),
        (format!("reconstruct @/photos {micro} -o @/a.gltf"), "a.gltf"),
        ("convert @/scene.ply @/b.ply".into(), "b.ply"),
        ("convert @/micro.safetensors @/b.safetensors".into(), "b.safetensors"),
        (format!("render @/scene.ply {small} --video @/c.gif"), "c.gif"),
        (format!("render @/scene.ply {small} --video @/c.apng"), "c.apng"),
        (format!("render @/scene.ply {small} -o @/out"), "out/contact.png"),
        (format!("eval @/place --views 2 {micro} --csv @/d.csv -o @/eval"), "d.csv"),
        (format!("eval @/place --views 2 {micro} --csv @/d.csv -o @/eval"), "eval/scene.ply"),
        (format!("eval @/place --views 2 {micro} --csv @/d.csv -o @/eval"), "eval/comparison.png"),
        ("scene --views 2 --size 28x28 --splats -o @/s".into(), "s/splats.ply"),
        ("scene --views 2 --size 28x28 --splats -o @/s".into(), "s/transforms.json"),
        ("scene --views 2 --size 28x28 --splats -o @/s".into(), "s/images/001.png"),
        ("scene --views 2 --size 14x14 --scenes 1 --shards @/e.bin".into(), "e.bin"),
    ];
    for (line, file) in cases {
        let path = folder.path(file);
        folder.run(&line).success();
        folder.run(&line).success();
        let written = std::fs::read(&path).expect("it was written");
        let mine = [b"ply\nmine: no zipsplat\n".as_slice(), &[7; 100_000]].concat();
        std::fs::write(&path, &mine).expect("a file");
        let name = path.file_name().expect("a name").to_string_lossy().into_owned();
        folder.run(&line).fails(3, &["file to replace", &name, "--overwrite"]);
        assert!(std::fs::read(&path).expect("a file") == mine, "{file} was replaced");
        folder.run(&format!("{line} --overwrite")).success();
        assert!(std::fs::read(&path).expect("a file") == written, "{file} is another");
        std::fs::write(&path, "").expect("a file");
        folder.run(&line).success();
    }
    for file in ["000.png", "contact.png"] {
        folder.write(&format!("pictures/{file}"), "mine");
        let line = format!("reconstruct @/photos {micro} --pictures @/pictures -o @/new.ply");
        folder.run(&line).fails(3, &["file to replace", file, "--overwrite"]);
        assert!(!folder.path("new.ply").exists(), "the scene comes first");
        folder.remove(&format!("pictures/{file}"));
    }
    // No author tag.
    let line = format!("reconstruct @/photos {micro} -o @/a.splat");
    folder.run(&line).success();
    folder.run(&line).fails(3, &["a.splat", "does not say"]);
    folder.run(&format!("{line} --overwrite")).success();
}

#[test]
fn what_a_longer_run_left_is_removed() {
    let folder = folder();
    let draw = |frames: usize, options: &str| {
        folder.run(&format!("render @/scene.ply --orbit --frames {frames} --size 16x16 {options} -o @/out")).success();
        names(&folder.path("out"))
    };
    draw(5, "--depth --alpha");
    let mine = crate::photo(8, 6, 1);
    std::fs::copy(folder.path("scene.ply"), folder.path("out/250.ply")).expect("copied");
    for name in ["003.png", "004.alpha.png", "0042.png", "notes.png"] {
        mine.save_png(folder.path("out").join(name)).expect("a photo can be written");
    }
    let left = draw(3, "--depth");
    let kept = ["000", "001", "002"].map(|n| [format!("{n}.alpha.png"), format!("{n}.depth.png"), format!("{n}.png")]);
    let mut expected: Vec<String> = kept.into_iter().flatten().collect();
    expected.extend(["003.png", "004.alpha.png", "0042.png", "250.ply", "contact.png", "notes.png"].map(str::to_owned));
    expected.sort();
    assert_eq!(left, expected);
    for name in ["003.png", "notes.png"] {
        assert_eq!(Image::open(folder.path("out").join(name)).expect("a photo"), mine);
    }
    for views in [4, 2] {
        folder.run(&format!("scene --views {views} --size 28x28 -o @/place")).success();
        for folder_of in ["place/images", "place/depth"] {
            assert_eq!(names(&folder.path(folder_of)).len(), views, "{folder_of}");
        }
    }
}

#[test]
fn nothing_is_removed_by_a_run_that_fails() {
    let folder = folder();
    folder.run("render @/scene.ply --orbit --frames 4 --size 16x16 -o @/out").success();
    let before = names(&folder.path("out"));
    write_ply(&Scene::default(), folder.path("empty.ply")).expect("an empty scene");
    let outcome = folder.run("render @/empty.ply --orbit --frames 2 --size 16x16 -o @/out");
    assert_eq!((outcome.code, names(&folder.path("out"))), (3, before));
    let cameras = [scenes::camera(16, 16)];
    write_transforms(folder.path("c.json"), &cameras, &["a.png"]).expect("cameras");
    folder.run("render @/scene.ply --cameras @/c.json -o @/out").success();
    assert_eq!(names(&folder.path("out")), ["000.png", "contact.png"]);
}
