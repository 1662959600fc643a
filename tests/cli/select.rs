use crate::Folder;
use zipsplat::types::{Scene, read_ply_property, write_ply};
use zipsplat_tests::{architectures, scenes};

const SIZE: u32 = 64;

/// Two objects of 100 Gaussians, left and right, in front of two cameras.
pub fn objects(folder: &Folder) -> Scene {
    let mut scene = scenes::random_scene(200, 0, 0.2);
    for (i, mean) in scene.means.iter_mut().enumerate() {
        let side = if i < 100 { -1.0 } else { 1.0 };
        *mean = [side + 0.4 * (i % 10) as f32 / 10.0 - 0.2, 0.5 * (i / 10 % 10) as f32 / 10.0 - 0.25, 4.0];
        (scene.scales[i], scene.opacities[i]) = ([0.05; 3], 0.5);
    }
    write_ply(&scene, folder.path("scene.ply")).expect("a scene can be written");
    let frame = |name: &str, x: f64| {
        format!(
            r#"{{"file_path": "{name}.png", "transform_matrix": [[1, 0, 0, {x}], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}}"#
        )
    };
    let lens = format!(r#""fl_x": {SIZE}, "fl_y": {SIZE}, "cx": 32, "cy": 32, "w": {SIZE}, "h": {SIZE}"#);
    let cameras = format!(r#"{{{lens}, "frames": [{}, {}]}}"#, frame("a", 0.0), frame("b", 0.2));
    std::fs::write(folder.path("cameras.json"), cameras).expect("a file");
    scene
}

pub fn picture(folder: &Folder, name: &str, [left, right]: [u8; 2]) {
    let path = folder.path(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    let value = |x, _| image::Luma([if x < SIZE / 2 { left } else { right }]);
    image::GrayImage::from_fn(SIZE, SIZE, value).save(path).expect("a picture can be written");
}

#[test]
fn masks_and_clicks_select_an_object() {
    let folder = Folder::new();
    let scene = objects(&folder);
    picture(&folder, "masks/a.png", [255, 0]);
    picture(&folder, "labels/a.png", [2, 1]);
    picture(&folder, "labels/b.png", [2, 1]);
    let selected = |words: &str| {
        let json =
            folder.run(&format!("select @/scene.ply {words} --cameras @/cameras.json -o @/out.ply --json")).json();
        assert_eq!((&json["selected"], &json["input_gaussians"]), (&100.into(), &200.into()), "{words}");
        Scene::open(folder.path("out.ply")).expect("a scene")
    };
    assert_eq!(selected("--masks @/masks").means, scene.means[..100]);
    assert_eq!(selected("--masks @/masks --remove").means, scene.means[100..]);
    let lift = "lift @/scene.ply @/labels --labels 3 --cameras @/cameras.json -o @/labels.safetensors --json";
    let json = folder.run(lift).json();
    assert_eq!((&json["rows"], &json["channels"], &json["photos"]), (&200.into(), &3.into(), &2.into()));
    // A palette's indices, of four bits, count; its colors do not.
    let palette = std::fs::File::create(folder.path("labels/b.png")).expect("a file");
    let mut encoder = png::Encoder::new(palette, SIZE, SIZE);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Four);
    encoder.set_palette([0, 0, 0, 128, 0, 0, 0, 128, 0].as_slice());
    let row = [[0x22; SIZE as usize / 4], [0x11; SIZE as usize / 4]].concat();
    let mut writer = encoder.write_header().expect("written");
    writer.write_image_data(&row.repeat(SIZE as usize)).expect("written");
    drop(writer);
    let of_gray = folder.read("labels.safetensors");
    folder.run(lift).success();
    assert!(folder.read("labels.safetensors") == of_gray, "labels of a palette");
    image::RgbImage::new(SIZE, SIZE).save(folder.path("labels/b.png")).expect("a picture");
    let lift = lift.trim_end_matches(" --json");
    folder.run(lift).fails(3, &["b.png", "Rgb", "gray or palette"]);
    image::GrayImage::new(SIZE / 2, SIZE).save(folder.path("labels/b.png")).expect("a picture");
    folder.run(lift).fails(3, &["b.png", "32x64", "64x64"]);
    let features = "--features @/labels.safetensors";
    assert_eq!(selected(&format!("--at 16,32 --view b.png {features}")).means, scene.means[..100]);
    assert_eq!(selected(&format!("--at 48,32 --view a.png {features}")).means, scene.means[100..]);
    assert_eq!(selected(&format!("--masks @/masks {features} --threshold 0.9")).means, scene.means[..100]);
}

fn mean_iou(found: &[u8], truth: &[u8]) -> f64 {
    let counted = |label: u8| {
        let pairs = found.iter().zip(truth).filter(|(_, truth)| **truth != 255);
        let [mut both, mut either] = [0.0; 2];
        for (found, truth) in pairs {
            both += f64::from(u8::from(*found == label && *truth == label));
            either += f64::from(u8::from(*found == label || *truth == label));
        }
        both / either
    };
    let mut labels: Vec<u8> = truth.iter().copied().filter(|label| *label != 255).collect();
    labels.sort_unstable();
    labels.dedup();
    labels.iter().map(|label| counted(*label)).sum::<f64>() / labels.len() as f64
}

#[test]
fn labels_of_some_photos_are_those_of_others() {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 12 --size 84x84 --splats -o @/place").success();
    folder.make("labels");
    for i in (0..12).step_by(2) {
        let [from, to] = ["place/labels", "labels"].map(|part| folder.path(&format!("{part}/{i:03}.png")));
        std::fs::copy(from, to).expect("copied");
    }
    let cameras = "--cameras @/place/transforms.json";
    folder.run(&format!("lift @/place/splats.ply @/labels --labels 12 {cameras} -o @/labels.safetensors")).success();
    let render = format!("render @/place/splats.ply {cameras} --features @/labels.safetensors -o @/out");
    folder.run(&render).success();
    let (mut found, mut truth) = (Vec::new(), Vec::new());
    for i in (1..12).step_by(2) {
        let bytes = folder.read(&format!("out/{i:03}.features.npy"));
        assert!(String::from_utf8_lossy(&bytes[..128]).contains("(84, 84, 12)"));
        let values: Vec<f32> = bytes[128..].as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        let largest = |row: &[f32]| (0..12).max_by(|a, b| row[*a].total_cmp(&row[*b])).expect("labels") as u8;
        found.extend(values.chunks_exact(12).map(largest));
        let labels = image::open(folder.path(&format!("place/labels/{i:03}.png"))).expect("labels").into_luma8();
        truth.extend(labels.into_raw().into_iter().map(|label| if label < 12 { label } else { 255 }));
    }
    let iou = mean_iou(&found, &truth);
    // Borders are a large part of small pictures.
    assert!(iou > 0.75, "{iou:.3}");
}

#[test]
fn a_networks_patch_tokens_are_lifted() {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 4 --size 84x56 --splats -o @/place").success();
    let line = "lift @/place/splats.ply --weights @/micro.safetensors --cameras @/place/transforms.json";
    let json = folder.run(&format!("{line} --views 3 -o @/tokens.safetensors --json")).json();
    let width = architectures::golden("micro").width;
    assert_eq!((&json["photos"], &json["channels"]), (&3.into(), &width.into()));
    let scene = Scene::open(folder.path("place/splats.ply")).expect("a scene");
    assert_eq!(json["rows"], scene.len());
    let seen = json["seen"].as_u64().expect("a number") as usize;
    assert!(seen > scene.len() / 4 && seen < scene.len(), "{seen} of {}", scene.len());
    folder.run(&format!("{line} --labels 3 -o @/x.safetensors")).fails_usage();
}

#[test]
fn depth_networks_patch_tokens_are_lifted() {
    let folder = Folder::new().with_depth().with_vggt();
    folder.run("scene --seed 5 --views 4 --size 84x56 --splats -o @/place").success();
    let scene = Scene::open(folder.path("place/splats.ply")).expect("a scene");
    for (weights, width) in [("da3", 128), ("alone", 64), ("vggt", 128)] {
        let line = format!("lift @/place/splats.ply --weights @/{weights}.safetensors --views 2");
        let json =
            folder.run(&format!("{line} --cameras @/place/transforms.json -o @/f.safetensors --json --overwrite"));
        let json = json.json();
        assert_eq!((&json["photos"], &json["channels"]), (&2.into(), &width.into()), "{weights}");
        let seen = json["seen"].as_u64().expect("a number") as usize;
        assert!(seen > scene.len() / 2, "{weights}: {seen} of {}", scene.len());
    }
}

#[test]
fn a_lift_is_planned() {
    let folder = Folder::new();
    objects(&folder);
    picture(&folder, "labels/a.png", [2, 1]);
    let line = "lift @/scene.ply @/labels --labels 3 --cameras @/cameras.json --dry-run --json";
    let plan = folder.run(&format!("--device none {line}")).json();
    let number = |key: &str| plan[key].as_u64().expect(key);
    assert_eq!(number("peak_bytes"), number("scene_bytes") + number("feature_bytes") + number("arena_bytes"));
    assert_eq!((&plan["channels"], &plan["photos"], &plan["parts"]), (&3.into(), &1.into(), &1.into()));
    folder.run(&format!("{line} -o @/x.safetensors")).fails_usage();
    folder.run("lift @/scene.ply --cameras @/cameras.json --dry-run").fails_usage();
}

#[test]
fn a_selection_is_a_property_that_other_programs_ignore() {
    let folder = Folder::new();
    objects(&folder);
    let scene = Scene::open(folder.path("scene.ply")).expect("a scene");
    picture(&folder, "masks/a.png", [255, 0]);
    let select = |words: &str| folder.run(&format!("select {words} --cameras @/cameras.json"));
    select("@/scene.ply --masks @/masks --tag left -o @/tagged.ply").success();
    assert!(Scene::open(folder.path("tagged.ply")).expect("a scene") == scene);
    let values = read_ply_property(&folder.path("tagged.ply"), "left").expect("it has the property");
    assert!(values.iter().enumerate().all(|(i, value)| *value == f32::from(u8::from(i < 100))));
    select("@/tagged.ply --tagged left --remove -o @/right.ply").success();
    assert_eq!(Scene::open(folder.path("right.ply")).expect("a scene").means, scene.means[100..]);
    select("@/tagged.ply --tagged right -o @/x.ply").fails(3, &["tagged.ply", "right"]);
    select("@/scene.ply --masks @/masks --tag opacity -o @/x.ply").fails(3, &["opacity", "no other property"]);
    select("@/scene.ply --masks @/masks --tag left -o @/x.spz").fails(3, &["x.spz", ".ply"]);
}

#[test]
fn features_stay_aligned_through_edits() {
    let folder = Folder::new();
    objects(&folder);
    picture(&folder, "labels/a.png", [2, 1]);
    let cameras = "--cameras @/cameras.json";
    folder.run(&format!("lift @/scene.ply @/labels --labels 3 {cameras} -o @/labels.safetensors")).success();
    let features = "--features @/labels.safetensors";
    let left = |scene: &Scene| scene.means.iter().filter(|mean| mean[0] < 0.0).count();
    for name in ["edited.ply", "edited.spz", "edited.sog", "edited.splat"] {
        let edits = "--crop-box -2,-2,0,1.05,2,9 --decimate 0.7 --sort";
        folder.run(&format!("edit @/scene.ply {features} {edits} -o @/{name} --overwrite")).success();
        let edited = Scene::open(folder.path(name)).expect("a scene");
        assert!(left(&edited) < 100 && edited.len() < 150);
        let at = "--at 16,32 --view a.png --features @/edited.safetensors";
        let json = folder.run(&format!("select @/{name} {at} {cameras} -o @/left.ply --overwrite --json")).json();
        assert_eq!(json["selected"], left(&edited), "{name}");
        assert_eq!(left(&Scene::open(folder.path("left.ply")).expect("a scene")), left(&edited), "{name}");
    }
    let both = "edit @/scene.ply @/scene.ply -o @/both.ply";
    folder.run(&format!("{both} {features}")).fails(3, &["--features", "1 file", "2 scenes"]);
    folder.run(&format!("{both} {features} @/labels.safetensors")).success();
    let at = "select @/both.ply --at 48,32 --view a.png --features @/both.safetensors";
    assert_eq!(folder.run(&format!("{at} {cameras} -o @/right.ply --json")).json()["selected"], 200);
}

#[test]
fn invalid_selections_and_values_name_themselves() {
    let folder = Folder::new();
    let scene = objects(&folder);
    picture(&folder, "masks/a.png", [255, 0]);
    picture(&folder, "empty/c.png", [255, 0]);
    let alike = folder.text("cameras.json").replace("a.png", "left/a.png").replace("b.png", "right/a.png");
    folder.write("alike.json", alike);
    let shared = folder.run("lift @/scene.ply @/masks --cameras @/alike.json -o @/f.safetensors");
    shared.fails(3, &["values of right/a.png", "a.png, as of left/a.png"]);
    let lift = "--cameras @/cameras.json -o @/f.safetensors";
    folder.run(&format!("lift @/scene.ply @/masks {lift}")).success();
    let select = "--cameras @/cameras.json -o @/out.ply";
    write_ply(&Scene { opacities: vec![0.4; 200], ..scene }, folder.path("other.ply")).expect("a scene");
    for (line, code, words) in [
        (format!("lift @/scene.ply @/empty {lift}"), 3, &["empty", "no values", "NAME.npy"][..]),
        (format!("lift @/scene.ply @/masks {lift} --gaussians-per-token 7"), 3, &["Gaussians per feature", "7", "200"]),
        (format!("select @/scene.ply {select}"), 3, &["selection", "--masks", "--at"]),
        (
            format!("select @/scene.ply --at 70,2 --view a.png --features @/f.safetensors {select}"),
            3,
            &["--at", "70,2", "64 x 64"],
        ),
        (
            format!("select @/scene.ply --at 1,1 --view a.png --features @/f.safetensors {select}"),
            3,
            &["--at", "no Gaussian at 1,1"],
        ),
        (format!("select @/other.ply --masks @/masks --features @/f.safetensors {select}"), 3, &["features of scene"]),
    ] {
        folder.run(&line).fails(code, words);
        assert!(!folder.path("out.ply").exists(), "{line}");
    }
}
