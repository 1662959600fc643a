use crate::doctor::zipsplat;
use zipsplat_tests::prelude::*;

const COUNT: usize = 50;
const BAD: [usize; 3] = [3, 4, 40];
/// Formats with floats; their axes keep z.
const NAMES: [&str; 4] = ["scene.ply", "ascii.ply", "scene.splat", "scene.glb"];

/// Sets centers at [`BAD`] to z `value`; returns the scene without them.
fn spoilt(path: &Path, value: f32) -> Scene {
    let mut scene = random_scene(COUNT, 1, 0.1);
    // A .splat sorts by visibility: equal Gaussians keep their order.
    scene.scales.fill([0.1; 3]);
    scene.opacities.fill(0.5);
    let ascii = path.file_name().is_some_and(|name| name == "ascii.ply");
    scene.save(path).unwrap();
    let mut clean = Scene::open(path).unwrap();
    let mut bytes = std::fs::read(path).unwrap();
    if ascii {
        bytes = as_ascii(&clean, value);
    } else {
        for i in BAD {
            let z = scene.means[i][2].to_le_bytes();
            let places: Vec<usize> = (0..bytes.len() - 3).filter(|at| bytes[*at..at + 4] == z).collect();
            assert_eq!(places.len(), 1, "z of {i} in {}", path.display());
            bytes[places[0]..][..4].copy_from_slice(&value.to_le_bytes());
        }
    }
    std::fs::write(path, bytes).unwrap();
    for i in BAD {
        clean.means[i][2] = f32::NAN;
    }
    assert_eq!(clean.drop_invalid().unwrap(), BAD.len());
    clean
}

fn as_ascii(scene: &Scene, value: f32) -> Vec<u8> {
    let rest: Vec<String> = (0..9).map(|i| format!("f_rest_{i}")).collect();
    let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(' ');
    let properties = names.map(str::to_owned).chain(rest).map(|name| format!("property float {name}\n"));
    let mut text =
        format!("ply\nformat ascii 1.0\nelement vertex {COUNT}\n{}end_header\n", properties.collect::<String>());
    for i in 0..COUNT {
        let [x, y, z] = scene.means[i];
        let sh = &scene.sh_coeffs[4 * i..][..4];
        let channels = (0..3).flat_map(|c| sh[1..].iter().map(move |rgb| rgb[c]));
        let row = [x, y, if BAD.contains(&i) { value } else { z }]
            .into_iter()
            .chain(sh[0])
            .chain([0.0])
            .chain(scene.scales[i].map(f32::ln))
            .chain(scene.quats[i])
            .chain(channels);
        text += &(row.map(|value| value.to_string()).collect::<Vec<_>>().join(" ") + "\n");
    }
    text.into_bytes()
}

#[test]
fn near_planes_and_backgrounds_are_numbers() {
    let (scene, mut renderer) = (random_scene(COUNT, 0, 0.1), Renderer::new(device()));
    let mut refused = |options: RenderOptions, words: &[&str]| {
        assert_refused(renderer.render_scene(&scene, &[camera(8, 8)], &options), words);
    };
    refused(RenderOptions { near: Some(-1.0), ..RenderOptions::default() }, &["near plane", "-1"]);
    refused(RenderOptions { near: Some(f32::NAN), ..RenderOptions::default() }, &["near plane", "NaN"]);
    refused(
        RenderOptions { background: [0.0, f32::INFINITY, 0.0], ..RenderOptions::default() },
        &["background", "inf"],
    );
}

#[test]
fn they_are_refused_with_their_count_or_dropped() {
    let folder = tempfile::tempdir().unwrap();
    for name in NAMES {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let path = folder.path().join(name);
            let clean = spoilt(&path, value);
            let error = assert_refused(Scene::open(&path), &["3 of 50 Gaussians otherwise, the first is 3"]);
            assert!(matches!(error, Error::Format { .. }), "{error}");
            let mut scene = Scene::open_unchecked(&path).unwrap();
            assert_eq!((scene.len(), scene.drop_invalid().unwrap()), (COUNT, BAD.len()), "{name} {value}");
            assert!(name == "ascii.ply" || scene == clean, "{name} {value}: others changed");
            scene.validate().unwrap();
            assert_eq!(scene.drop_invalid().unwrap(), 0);
        }
    }
}

#[test]
fn every_field_counts_and_all_may_go() {
    let spoils: [fn(&mut Scene, usize); 7] = [
        |scene, i| scene.means[i][0] = f32::NAN,
        |scene, i| scene.scales[i][1] = f32::INFINITY,
        |scene, i| scene.scales[i][2] = -1.0,
        |scene, i| scene.quats[i] = [0.0; 4],
        |scene, i| scene.opacities[i] = 1.5,
        |scene, i| scene.opacities[i] = f32::NAN,
        |scene, i| scene.sh_coeffs[4 * i + 3][2] = f32::NEG_INFINITY,
    ];
    let whole = random_scene(20, 1, 0.1);
    let mut scene = whole.clone();
    spoils.iter().enumerate().for_each(|(i, spoil)| spoil(&mut scene, 2 * i));
    assert_eq!(scene.drop_invalid().unwrap(), spoils.len());
    scene.validate().unwrap();
    let kept: Vec<usize> = (0..20).filter(|i| i % 2 == 1 || *i >= 2 * spoils.len()).collect();
    assert_eq!(scene.means, kept.iter().map(|i| whole.means[*i]).collect::<Vec<_>>());
    assert_eq!(scene.sh_coeffs.len(), 4 * kept.len());
    scene.opacities.fill(f32::NAN);
    assert_eq!((scene.drop_invalid().unwrap(), scene.len()), (kept.len(), 0));
    scene.validate().unwrap();
    scene.quats.push([1.0; 4]);
    assert!(scene.drop_invalid().is_err(), "arrays that do not fit each other");
}

#[test]
fn commands_say_how_to_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let run = |line: &str| zipsplat(&line.replace('@', &folder.path().display().to_string()));
    let written = |name: &str, scene: &Scene| scene.save(at(name)).unwrap();
    for name in NAMES {
        let clean = spoilt(&at(name), f32::NAN);
        let lines = [
            ("render @/NAME --wiggle -o @/out", "out"),
            ("convert @/NAME @/out.ply", "out.ply"),
            ("convert @/NAME", ""),
        ];
        for (line, output) in lines {
            let line = line.replace("NAME", name);
            let (code, out, err) = run(&line);
            let nothing = output.is_empty() || !at(output).exists();
            assert!((code, out.as_str(), nothing) == (3, "", true), "{line}: {code} {out}");
            for words in ["3 of 50", "scene means", "--drop-invalid"] {
                assert!(err.contains(words), "{line}: {err}");
            }
            assert_eq!(run(&format!("{line} --invalid refuse")).0, 3);
            let (code, out, err) = run(&format!("{line} --drop-invalid --json"));
            let json: serde_json::Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{line}: {code} {err}"));
            let json = &json["result"];
            assert_eq!((&json["gaussians"], &json["dropped"]), (&47.into(), &3.into()), "{line}");
            assert!(err.contains("3 of 50 Gaussians left out"), "{line}: {err}");
        }
        if name != "ascii.ply" {
            assert_eq!(Scene::open(at("out.ply")).unwrap().means, clean.means);
        }
        written("clean.ply", &Scene::open(at("out.ply")).unwrap());
        let (code, _, err) = run("render @/clean.ply --wiggle -o @/clean");
        assert_eq!((code, err.as_str()), (0, ""));
        let picture = |folder: &str| std::fs::read(at(folder).join("000.png")).unwrap();
        if name == "scene.ply" {
            assert!(picture("out") == picture("clean"), "{name}");
        }
        ["out", "clean"].iter().for_each(|name| std::fs::remove_dir_all(at(name)).unwrap());
        std::fs::remove_file(at("out.ply")).unwrap();
    }
    let (code, out, _) = run("convert @/clean.ply --drop-invalid --json");
    assert!(code == 0 && out.contains("\"dropped\": 0"), "{out}");
    let (code, _, err) = run("convert seeded:vits @/weights.safetensors --drop-invalid");
    assert!(code == 3 && err.contains("--drop-invalid"), "{err}");
    assert_eq!(run("render @/clean.ply --wiggle -o @/out --invalid keep").0, 2);
}
