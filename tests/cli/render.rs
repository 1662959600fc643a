use crate::{Folder, names};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use zipsplat::types::{Camera, Image, Pose, poses::write_transforms, write_ply};
use zipsplat_tests::scenes;

fn folder() -> Folder {
    let folder = Folder::new();
    folder.scatter("scene.ply", 200, 1, 0.2);
    let camera = |size: (u32, u32), x: f64| Camera {
        pose: Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY },
        ..scenes::camera(size.0, size.1)
    };
    let cameras = [camera((48, 32), 0.0), camera((32, 32), 0.5), camera((48, 32), -0.5)];
    write_transforms(folder.path("cameras.json"), &cameras, &["c/a.png", "c/b.png", "c/c.png"]).expect("cameras");
    folder
}

fn contents(folder: &Folder, name: &str) -> BTreeMap<String, Vec<u8>> {
    let path = folder.path(name);
    let read = |name: String| (name.clone(), std::fs::read(path.join(name)).expect("a file"));
    names(&path).into_iter().map(read).collect()
}

#[test]
fn every_camera_gets_a_picture_and_again_the_same() {
    let folder = folder();
    let draw = |out: &str| {
        folder.run(&format!("render @/scene.ply --cameras @/cameras.json -o @/{out}")).success();
        contents(&folder, out)
    };
    let (first, second) = (draw("a"), draw("b"));
    assert_eq!(first.keys().collect::<Vec<_>>(), ["000.png", "001.png", "002.png", "contact.png"]);
    assert_eq!(first, second);
    let size = |name: &str| Image::size(folder.path(name)).expect("a picture");
    assert_eq!([size("a/000.png"), size("a/001.png"), size("a/contact.png")], [(48, 32), (32, 32), (96, 64)]);
    assert_ne!(first["000.png"], first["002.png"]);
}

#[test]
fn gaussians_are_drawn_as_points() {
    let folder = folder();
    let mut scene = scenes::random_scene(1, 0, 0.2);
    (scene.means[0], scene.scales[0], scene.opacities[0]) = ([0.0, 0.0, 2.0], [1.0; 3], 0.2);
    scene.sh_coeffs[0] = [1.7, -1.7, -1.7];
    write_ply(&scene, folder.path("one.ply")).expect("a scene can be written");
    let draw = |options: &str| {
        folder.run(&format!("render @/one.ply --cameras @/cameras.json {options} -o @/out")).success();
        Image::open(folder.path("out/000.png")).expect("a picture")
    };
    let lit = |image: &Image| image.rgb.chunks_exact(3).filter(|pixel| pixel[0] > 20).count();
    let [whole, wide, narrow] = [draw(""), draw("--point-size 0.4"), draw("--point-size 0.1")];
    assert!(lit(&whole) > 1000 && lit(&wide) < 500 && lit(&narrow) < lit(&wide) && lit(&narrow) > 0);
    let middle = 3 * (16 * 48 + 24);
    assert!(whole.rgb[middle] < 80 && wide.rgb[middle] > 200 && wide.rgb[middle + 1] < 30, "no opaque dot");
    let line = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/s.ply --pictures @/p -- --wiggle --point-size 1";
    folder.run(line).fails(3, &["--point-size", "words behind --"]);
}

#[test]
fn antialiased_scenes_are_faded_unless_the_option_says_otherwise() {
    let folder = folder();
    folder.scatter("thin.ply", 200, 1, 0.02);
    folder.run("convert @/thin.ply @/tagged.ply --antialiased").success();
    let draw = |options: &str| {
        folder.run(&format!("render {options} --cameras @/cameras.json -o @/out")).success();
        contents(&folder, "out").remove("000.png").expect("a picture")
    };
    let [plain, faded] = [draw("@/thin.ply"), draw("@/tagged.ply")];
    assert_ne!(plain, faded);
    assert_eq!(draw("@/thin.ply --antialiased"), faded);
    assert_eq!(draw("@/tagged.ply --antialiased=false"), plain);
}

#[test]
fn depth_and_alpha_are_what_the_renderer_gives() {
    let folder = folder();
    folder.write("out/mine.txt", "stays");
    let line =
        "render @/scene.ply --cameras @/cameras.json --depth --alpha --antialiased --background 1,0.5,0 -o @/out";
    let text = folder.run(line).success();
    assert!(text.contains("depth: 1000 levels a world unit"), "{text}");
    let open = |name: &str| image::open(folder.path(name)).expect("a picture");
    let image::DynamicImage::ImageLuma16(depth) = open("out/000.depth.png") else { panic!("depth has 16 bits") };
    let image::DynamicImage::ImageLuma8(alpha) = open("out/000.alpha.png") else { panic!("alpha has 8 bits") };
    assert_eq!((depth.dimensions(), alpha.dimensions()), ((48, 32), (48, 32)));
    // The Gaussians are 1 to 6 units away, some wider than 0.1.
    let seen = depth.pixels().zip(alpha.pixels()).filter(|(_, alpha)| alpha.0[0] > 64);
    let depths: Vec<u16> = seen.map(|(depth, _)| depth.0[0]).collect();
    assert!(depths.len() > 20, "{} pixels", depths.len());
    assert!(depths.iter().all(|depth| (900..6100).contains(depth)), "{depths:?}");
    let names = names(&folder.path("out"));
    assert_eq!(names.len(), 3 * 3 + 2, "{names:?}");
    assert!(names.contains(&"mine.txt".to_owned()));
}

#[test]
fn colors_have_several_spellings() {
    let folder = folder();
    let draw = |color: &str| {
        folder.run(&format!("render @/scene.ply --cameras @/cameras.json --background {color} -o @/out")).success();
        contents(&folder, "out")
    };
    let aqua = draw("0,1,1");
    assert!(aqua == draw("#00ffff") && aqua == draw("aqua"), "the same color");
    assert!(aqua != draw("teal") && draw("#fff") == draw("White"), "the same color");
    let line = "render @/scene.ply --orbit -o @/out --background";
    let refused = folder.run(&format!("{line} #ffff"));
    assert!(refused.code == 2 && refused.err.contains("'#ffffff'") && refused.err.contains("teal"), "{}", refused.err);
}

#[test]
fn paths_have_as_many_pictures_as_asked() {
    let folder = folder();
    for path in ["--orbit", "--wiggle"] {
        let json = folder.run(&format!("render @/scene.ply {path} --frames 5 --size 20x16 --json -o @/{path}")).json();
        assert_eq!(json["frames"], 5);
        let files = contents(&folder, path);
        assert_eq!(files.len(), 6);
        let pictures: std::collections::BTreeSet<_> = files.values().collect();
        // A wiggle passes its center twice.
        assert!(pictures.len() >= 5, "{} different pictures", pictures.len());
    }
}

#[test]
fn cameras_count_from_a_photo_and_fit_a_size() {
    let folder = folder();
    let line = "render @/scene.ply --cameras @/cameras.json --size 24x24 -o @";
    folder.run(&format!("{line}/all")).success();
    folder.run(&format!("{line}/from --relative-to elsewhere/b.png")).success();
    let (all, from) = (contents(&folder, "all"), contents(&folder, "from"));
    assert_eq!(Image::size(folder.path("all/000.png")).expect("a picture"), (24, 24));
    assert_ne!(all["001.png"], from["001.png"]);
}

#[test]
fn a_scene_finds_its_cameras_in_their_own_file() {
    let folder = folder();
    folder.run("scene --seed 4 --views 3 --size 28x28 -o @/place").success();
    folder.edit_frames("place/transforms.json", |frame| {
        let x = frame["transform_matrix"][0][3].as_f64().expect("a number");
        frame["transform_matrix"][0][3] = (x + 1000.0).into();
    });
    folder.run("reconstruct @/place/images --cameras @/place --scene-scale 1 -o @/posed.ply").success();
    let found = folder.run("render @/posed.ply --cameras @/place -o @/found");
    assert_eq!(found.err, "", "the world needs no note");
    found.success();
    folder.run("render @/posed.ply --cameras @/place --relative-to 000.png -o @/named").success();
    assert_eq!(contents(&folder, "found"), contents(&folder, "named"));
    for format in ["spz", "glb", "gltf"] {
        folder.run(&format!("convert @/posed.ply @/posed.{format}")).success();
        assert!(!says_empty(&folder, &format!("render @/posed.{format} --cameras @/place -o @/{format}")), "{format}");
    }
    let noted = folder.run("convert @/posed.ply @/posed.splat");
    assert!(noted.err.contains("--relative-to images/000.png"), "{}", noted.err);
    let lost = folder.run("render @/posed.splat --cameras @/place -o @/lost");
    assert!(lost.err.contains("does not say which world"), "{}", lost.err);
    assert!(lost.err.contains("but the background") && lost.err.contains("--relative-to PHOTO"), "{}", lost.err);
    lost.success();
    assert!(!says_empty(&folder, "render @/posed.splat --cameras @/place --relative-to 000.png -o @/again"));
    let text = folder.text("place/transforms.json").replace("000.png", "zero.png");
    folder.write("other.json", text);
    let other = folder.run("render @/posed.ply --cameras @/other.json -o @/other");
    assert!(
        other.err.contains("images/000.png, which") && other.err.contains("--world input-cameras"),
        "{}",
        other.err
    );
}

#[test]
fn a_scene_can_be_in_the_world_of_its_cameras() {
    let folder = folder();
    folder.run("scene --seed 4 --views 3 --size 28x28 -o @/place").success();
    let path = folder.path("place/transforms.json");
    let poses = zipsplat::types::poses::Capture::open(&path).expect("cameras");
    let turn = DMat3::from_rotation_x(1.2) * DMat3::from_rotation_z(-0.6);
    let world = Pose { rotation: turn, translation: DVec3::new(-40.0, 7.0, 90.0) };
    let moved = |camera: Camera| {
        let pose = Pose { translation: 4.0 * camera.pose.translation, ..camera.pose };
        Camera { pose: world.compose(&pose), ..camera }
    };
    let cameras: Vec<Camera> = poses.frames.iter().map(|frame| moved(frame.camera)).collect();
    let names: Vec<&str> = poses.frames.iter().map(|frame| frame.name.as_str()).collect();
    write_transforms(&path, &cameras, &names).expect("cameras");
    let draw = |name: &str, options: &str, path: &str| {
        let scene = format!("@/{name}.ply");
        folder
            .run(&format!("reconstruct @/place/images --cameras @/place --scene-scale 4 {options} -o {scene}"))
            .success();
        let outcome = folder.run(&format!("render {scene} {path} -o @/{name}"));
        assert!(!outcome.err.contains("but the background"), "{}", outcome.err);
        let (err, _) = (outcome.err.clone(), outcome.success());
        (err, contents(&folder, name).into_keys().map(|file| picture(&folder, &format!("{name}/{file}"))).collect())
    };
    let close = |a: &[Image], b: &[Image]| {
        let differences = a.iter().zip(b).flat_map(|(a, b)| a.rgb.iter().zip(&b.rgb)).map(|(a, b)| a.abs_diff(*b));
        assert_eq!(a.len(), b.len());
        assert!(differences.clone().max() < Some(8), "{:?}", differences.max());
    };
    let (_, first): (_, Vec<Image>) = draw("first", "", "--cameras @/place");
    let (notes, own) = draw("own", "--world input-cameras", "--cameras @/place");
    assert_eq!(notes, "", "there is nothing to say where all fits");
    close(&first, &own);
    for path in ["--wiggle", "--orbit", "--dolly"] {
        let path = format!("{path} --frames 3 --size 28x28");
        close(&draw("first", "", &path).1, &draw("own", "--world input-cameras", &path).1);
    }
    assert_eq!(folder.run("reconstruct @/place/images --world input-cameras -o @/x.ply").code, 2);

    write_transforms(folder.path("other.json"), &poses.frames.iter().map(|f| f.camera).collect::<Vec<_>>(), &names)
        .expect("cameras");
    for scene in ["first", "own"] {
        let outcome = folder.run(&format!("render @/{scene}.ply --cameras @/other.json -o @/other"));
        assert!(outcome.err.contains("in another world than the scene: aligned"), "{}", outcome.err);
        outcome.success();
        let other: Vec<Image> =
            contents(&folder, "other").into_keys().map(|f| picture(&folder, &format!("other/{f}"))).collect();
        close(&first, &other);
    }
    let mirrored = poses.frames.iter().map(|frame| {
        let center = frame.camera.pose.translation;
        Camera { pose: Pose { translation: -center, ..frame.camera.pose }, ..frame.camera }
    });
    write_transforms(folder.path("mirrored.json"), &mirrored.collect::<Vec<_>>(), &names).expect("cameras");
    let refused = folder.run("render @/own.ply --cameras @/mirrored.json -o @/mirrored");
    refused.fails(3, &["cameras of", "mirrored.json", "another direction"]);
    let kept = folder.run("refine @/first.ply @/place/images --cameras @/other.json --steps 2 -o @/refined.ply");
    assert!(kept.err.contains("aligned"), "{}", kept.err);
    kept.success();
}

fn picture(folder: &Folder, name: &str) -> Image {
    Image::open(folder.path(name)).expect("a picture")
}

fn says_empty(folder: &Folder, line: &str) -> bool {
    let outcome = folder.run(line);
    let notes = outcome.err.contains("but the background");
    outcome.success();
    notes
}

#[test]
fn only_own_pictures_are_replaced() {
    let folder = folder();
    let line = "render @/scene.ply --cameras @/cameras.json --depth --alpha --normals --gaussians-per-token 8 -o @/out";
    folder.run(line).success();
    let drawn = contents(&folder, "out");
    folder.run(line).success();
    let mine = crate::photo(8, 6, 1);
    for name in ["000.png", "002.depth.png", "001.alpha.png", "000.normal.png", "002.tokens.png", "contact.png"] {
        mine.save_png(folder.path("out").join(name)).expect("a photo can be written");
        folder.run(line).fails(3, &[name, "--overwrite"]);
        assert_eq!(Image::open(folder.path("out").join(name)).expect("a photo"), mine, "{name}");
        folder.run(&format!("{line} --overwrite")).success();
        assert_eq!(contents(&folder, "out"), drawn);
    }
    mine.save_png(folder.path("out/000.alpha.png")).expect("a photo can be written");
    mine.save_png(folder.path("out/003.png")).expect("a photo can be written");
    folder.run("render @/scene.ply --cameras @/cameras.json --depth -o @/out").success();
}

#[test]
fn normals_and_tokens_are_written_where_asked() {
    let folder = folder();
    folder
        .run("render @/scene.ply --cameras @/cameras.json --normals --gaussians-per-token 8 --depth=accumulated -o @/out")
        .success();
    let names: Vec<String> = names(&folder.path("out")).into_iter().filter(|name| name.starts_with("000")).collect();
    assert_eq!(names, ["000.depth.png", "000.normal.png", "000.png", "000.tokens.png"]);
    for name in ["out/000.normal.png", "out/000.tokens.png"] {
        let picture = image::open(folder.path(name)).expect("a picture").to_rgb8();
        assert_eq!(picture.dimensions(), (48, 32));
        let colors: std::collections::BTreeSet<_> = picture.pixels().map(|pixel| pixel.0).collect();
        assert!(colors.len() > 20, "{name}: {} colors", colors.len());
    }
    folder.run("render @/scene.ply --wiggle --normals --video @/out.gif").fails(3, &["--normals", "-o FOLDER"]);
}

#[test]
fn explaining_names_passes_and_what_was_left_out() {
    let folder = folder();
    let line = "render @/scene.ply --cameras @/cameras.json --explain -o @/out";
    let text = folder.run(line).success();
    for words in
        ["render/project", "ops/sort_scatter", "together", "normals ", "not asked for", "band 2", "it is black"]
    {
        assert!(text.contains(words), "'{words}' is not in: {text}");
    }
    assert!(!text.contains("render/normals"), "{text}");
    let json = folder.run(&format!("{line} --normals --background 1,1,1 --json")).json();
    let passes = json["explain"]["passes"].as_array().expect("a list");
    let normals = passes.iter().find(|pass| pass["pass"] == "render/normals").expect("it ran");
    // Means, scales, quats and normals, and one camera.
    assert_eq!(normals["bytes"].as_u64(), Some(200 * (12 + 12 + 16 + 12) + 128));
    let skipped_passes = json["explain"]["skipped_passes"].as_array().expect("a list");
    let has = |what: &str| skipped_passes.iter().any(|left| left["what"] == what);
    assert!(has("depth") && !has("normals") && !has("background"), "{skipped_passes:?}");
}
