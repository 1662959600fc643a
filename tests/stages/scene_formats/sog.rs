use super::{assert_damaged, assert_rotations, assert_within, coefficient, scene};
use serde_json::{Value, json};
use std::io::{Cursor, Read, Write};
use std::process::Command;
use zip::{ZipArchive, ZipWriter, write::SimpleFileOptions};
use zipsplat::types::{SaveOptions, SceneFormat, read_ply};
use zipsplat_tests::prelude::*;

fn encoded(scene: &Scene) -> Vec<u8> {
    scene.encode(SceneFormat::Sog, &SaveOptions::default(), None).unwrap()
}

fn files(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    let count = archive.len();
    let mut file = |i: usize| {
        let (mut file, mut content) = (archive.by_index(i).unwrap(), Vec::new());
        file.read_to_end(&mut content).unwrap();
        (file.name().to_owned(), content)
    };
    (0..count).map(&mut file).collect()
}

fn archived(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in files {
        zip.start_file(name, SimpleFileOptions::default()).unwrap();
        zip.write_all(content).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// The truth's Gaussians in the order of `found`, by nearest mean.
fn ordered(truth: &Scene, found: &Scene) -> Scene {
    let distance = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    let nearest = |mean: &[f32; 3]| {
        (0..truth.len())
            .min_by(|a, b| distance(&truth.means[*a], mean).total_cmp(&distance(&truth.means[*b], mean)))
            .unwrap()
    };
    let order: Vec<usize> = found.means.iter().map(nearest).collect();
    let mut sorted = order.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (0..truth.len()).collect::<Vec<_>>(), "each Gaussian once");
    let mut truth = truth.clone();
    truth.keep(&order);
    truth
}

/// Half a step of the grids, or half the widest cell of a codebook.
#[track_caller]
fn assert_sog(found: &Scene, truth: &Scene, [scale, color, rest, opacity]: [f32; 4]) {
    let truth = ordered(truth, found);
    let log = |x: f32| x.signum() * x.abs().ln_1p();
    let logs = |scene: &Scene| scene.means.as_flattened().iter().map(|x| log(*x)).collect::<Vec<_>>();
    let reach = logs(&truth).iter().fold(0f32, |most, x| most.max(x.abs()));
    assert_within("log mean", &logs(found), &logs(&truth), |_| 2.0 * reach * 0.51 / 65535.0 + 1e-6);
    let ln = |scene: &Scene| scene.scales.as_flattened().iter().map(|scale| scale.max(1e-9).ln()).collect::<Vec<_>>();
    assert_within("log scale", &ln(found), &ln(&truth), |_| scale);
    assert_within("opacity", &found.opacities, &truth.opacities, |_| opacity);
    assert_within("color", &coefficient(found, 0), &coefficient(&truth, 0), |_| color);
    assert_rotations(&found.quats, &truth.quats, 0.02);
    for k in 1..truth.sh_coeffs_per_gaussian() {
        assert_within(&format!("sh {k}"), &coefficient(found, k), &coefficient(&truth, k), |_| rest);
    }
}

#[test]
fn sog_keeps_what_its_grids_and_codebooks_resolve() {
    for degree in 0..=3 {
        // Fewer Gaussians than palette entries: only the codebooks round.
        let truth = scene(degree);
        let bytes = encoded(&truth);
        let found = Scene::decode(&bytes, Some(SceneFormat::Sog)).unwrap();
        assert_eq!((found.len(), found.sh_degree), (400, degree));
        // Of ranges of 3, 3.4 and 0.6, few of 256 cells are wider than 1/64.
        assert_sog(&found, &truth, [3.0 / 64.0, 3.4 / 64.0, 0.6 / 64.0, 1.001 / 510.0]);
        assert!(encoded(&truth) == bytes);
    }
}

#[test]
fn larger_scenes_share_a_palette() {
    let mut truth = scenes::random_scene(6000, 1, 0.1);
    let bytes = encoded(&truth);
    let meta: Value = serde_json::from_slice(&files(&bytes)[0].1).unwrap();
    assert_eq!((&meta["shN"]["count"], &meta["shN"]["bands"]), (&json!(1500), &json!(1)));
    let found = Scene::decode(&bytes, Some(SceneFormat::Sog)).unwrap();
    let truth_in_order = ordered(&truth, &found);
    let mean_square = |of: &dyn Fn(usize) -> f32| {
        (0..found.sh_coeffs.len()).map(|i| of(i).powi(2)).sum::<f32>() / found.sh_coeffs.len() as f32
    };
    let error =
        mean_square(&|i| (found.sh_coeffs[i][1] - truth_in_order.sh_coeffs[i][1]) * f32::from(u8::from(i % 4 > 0)));
    let power = mean_square(&|i| truth_in_order.sh_coeffs[i][1] * f32::from(u8::from(i % 4 > 0)));
    // 1500 cells of nine uniform dimensions: 2.25 per dimension.
    assert!(error < 0.3 * power, "{error} of {power}");
    // Equal coefficients have one entry.
    for coeffs in truth.sh_coeffs.chunks_exact_mut(4) {
        coeffs[1..].fill([0.25; 3]);
    }
    let bytes = encoded(&truth);
    let meta: Value = serde_json::from_slice(&files(&bytes)[0].1).unwrap();
    assert_eq!(meta["shN"]["count"], json!(1));
    let found = Scene::decode(&bytes, Some(SceneFormat::Sog)).unwrap();
    assert!(found.sh_coeffs.chunks_exact(4).all(|coeffs| coeffs[1..] == [[0.25; 3]; 3]));
}

/// It truncates opacities, and its codebooks leave out invisible Gaussians.
#[test]
fn files_of_splat_transform_are_read() {
    let [found, truth] = ["scenes/scene.sog", "gaussians_deg2.ply"].map(|name| golden::find(name).unwrap());
    let (mut found, mut truth) = (Scene::open(found).unwrap(), read_ply(truth).unwrap());
    assert_eq!((found.len(), found.sh_degree), (7, 2));
    for scene in [&mut found, &mut truth] {
        scene.keep(&(0..7).filter(|i| scene.opacities[*i] > 0.01).collect::<Vec<_>>());
        assert_eq!(scene.len(), 5);
    }
    assert_sog(&found, &truth, [0.12, 0.03, 2.0, 1.001 / 255.0]);
}

#[test]
fn sog_files_of_older_programs_are_read() {
    let with = |change: &dyn Fn(&mut Value)| {
        let mut files = files(&encoded(&scene(1)));
        let mut meta: Value = serde_json::from_slice(&files[0].1).unwrap();
        change(&mut meta);
        files[0].1 = meta.to_string().into_bytes();
        Scene::decode(&archived(&files), Some(SceneFormat::Sog)).unwrap()
    };
    assert!(with(&|meta| meta["antialias"] = true.into()).antialiased);
    let codes = |first: Value| {
        with(&|meta| {
            for field in ["scales", "sh0", "shN"] {
                let code = |i: u8| {
                    if i == 0 { first.clone() } else { json!(f64::from(i) * f64::from(u8::from(i > 1)) / 256.0) }
                };
                meta[field]["codebook"] = (0..=255).map(code).collect();
            }
        })
    };
    assert_eq!(codes(Value::Null), codes(json!(-1.0 / 256.0)));
}

/// Skipped without npm or its registry.
#[test]
fn splat_transform_reads_ours() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let npm = Command::new("npm")
        .args(["install", "--silent", "--no-fund", "--no-audit", "--prefix"])
        .args([folder.path(), Path::new("@playcanvas/splat-transform@3.7.0")])
        .output();
    if !npm.as_ref().is_ok_and(|npm| npm.status.success()) {
        println!("skipped: npm cannot install @playcanvas/splat-transform: {npm:?}");
        return;
    }
    let truth = Scene { antialiased: true, ..scene(2) };
    let read = |name: &str| {
        truth.save(path(name)).unwrap();
        let mut program = Command::new(path("node_modules/.bin/splat-transform"));
        let run = program.args(["-q", "-g", "cpu", "-w"]).args([path(name), path("back.ply")]).output().unwrap();
        assert!(run.status.success(), "{run:?}");
        Scene::open(path("back.ply")).unwrap()
    };
    for name in ["scene.ply", "scene.spz"] {
        let back = read(name);
        assert_eq!((back.len(), back.antialiased), (400, true), "{name}");
    }
    let (back, own) = (read("scene.sog"), Scene::open(path("scene.sog")).unwrap());
    let tolerance = Tolerance { max: 1e-5, rms: 1e-5 };
    assert_eq!((back.len(), back.sh_degree, back.antialiased), (400, 2, true));
    assert_close("means", back.means.as_flattened(), own.means.as_flattened(), tolerance);
    assert_close("scales", back.scales.as_flattened(), own.scales.as_flattened(), tolerance);
    assert_close("opacities", &back.opacities, &own.opacities, tolerance);
    assert_close("sh", back.sh_coeffs.as_flattened(), own.sh_coeffs.as_flattened(), tolerance);
    assert_rotations(&back.quats, &own.quats, 1e-5);
}

#[test]
fn damaged_sog_files_say_where() {
    let bytes = encoded(&scene(1));
    assert_damaged("scene.sog", &bytes[..bytes.len() / 2], &["ZIP"]);
    let with = |name: &str, content: &[u8]| {
        let mut files = files(&bytes);
        files.iter_mut().filter(|file| file.0 == name).for_each(|file| file.1 = content.to_vec());
        archived(&files)
    };
    let meta = |at: &str, value: Value| {
        let mut meta: Value = serde_json::from_slice(&files(&bytes)[0].1).unwrap();
        *meta.pointer_mut(at).unwrap() = value;
        with("meta.json", meta.to_string().as_bytes())
    };
    assert!(Scene::decode(&archived(&files(&bytes)), Some(SceneFormat::Sog)).is_ok());
    assert_damaged("scene.sog", &with("meta.json", b"{"), &["meta.json"]);
    assert_damaged("scene.sog", &meta("/version", json!(1)), &["version 1", "expected 2"]);
    assert_damaged("scene.sog", &meta("/count", json!(500_000)), &["means_l.webp", "500000 or more"]);
    assert_damaged("scene.sog", &meta("/sh0/files/0", json!("no.webp")), &["no.webp"]);
    assert_damaged("scene.sog", &meta("/scales/codebook", json!([1.0])), &["scales", "1 codes", "256"]);
    assert_damaged("scene.sog", &meta("/shN/bands", json!(4)), &["4 bands", "0 to 3"]);
    assert_damaged("scene.sog", &meta("/shN/bands", json!(2)), &["shN_centroids.webp", "3200 or more"]);
    let codebook = vec![0.0; 256];
    let wide =
        json!({ "count": 1, "bands": 2, "codebook": codebook, "files": ["shN_centroids.webp", "shN_labels.webp"] });
    assert_damaged("scene.sog", &meta("/shN", wide), &["shN_centroids.webp", "width of 192", "expected 512"]);
    assert_damaged("scene.sog", &meta("/shN/count", json!(1)), &["shN_labels.webp", "of 1"]);
    assert_damaged("scene.sog", &with("quats.webp", b"RIFF"), &["quats.webp"]);
}
