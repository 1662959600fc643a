//! Tags in the spelling of each format's public readers.

use super::{round_trip, scene};
use std::io::{Cursor, Read};
use zipsplat::types::{SaveOptions, SceneFormat};
use zipsplat_tests::prelude::*;

fn tagged() -> Scene {
    Scene { antialiased: true, ..scene(1) }
}

fn encoded(scene: &Scene, format: SceneFormat, spz_version: u32) -> Vec<u8> {
    scene.encode(format, &SaveOptions { spz_version }, None).unwrap()
}

#[test]
fn formats_keep_it_or_say_that_they_do_not() {
    for &format in SceneFormat::ALL {
        for scene in [tagged(), scene(1)] {
            let found = round_trip(&scene, &format!("scene{}", format.extension()), &SaveOptions::default());
            assert_eq!(found.antialiased, scene.antialiased && format.keeps_antialiased(), "{format:?}");
        }
    }
    let keep = |format: &&SceneFormat| format.keeps_antialiased();
    let kept: Vec<SceneFormat> = SceneFormat::ALL.iter().filter(keep).copied().collect();
    assert_eq!(kept, [SceneFormat::Ply, SceneFormat::Spz, SceneFormat::Sog]);
    for version in [2, 4] {
        assert!(round_trip(&tagged(), "scene.spz", &SaveOptions { spz_version: version }).antialiased);
    }
}

#[test]
fn files_have_it_where_others_look() {
    let (tagged, plain) = (tagged(), scene(1));
    let header = |scene: &Scene| {
        let bytes = encoded(scene, SceneFormat::Ply, 3);
        String::from_utf8_lossy(&bytes).split("end_header").next().unwrap().to_owned()
    };
    assert!(header(&tagged).lines().any(|line| line == "comment SplatRenderMode: mip"));
    assert!(!header(&plain).contains("SplatRenderMode"));
    let flags =
        |scene: &Scene| [gunzip(&encoded(scene, SceneFormat::Spz, 3))[14], encoded(scene, SceneFormat::Spz, 4)[14]];
    assert_eq!((flags(&tagged), flags(&plain)), ([1, 1], [0, 0]));
    let model = |scene: &Scene| {
        let mut archive = zip::ZipArchive::new(Cursor::new(encoded(scene, SceneFormat::Sog, 3))).unwrap();
        let (mut meta, mut text) = (archive.by_name("meta.json").unwrap(), String::new());
        meta.read_to_string(&mut text).unwrap();
        serde_json::from_str::<serde_json::Value>(&text).unwrap().get("model").cloned()
    };
    assert_eq!((model(&tagged), model(&plain)), (Some("antialiased".into()), None));
}

/// Brush writes `SplatRenderMode`, Postshot `antialiased`.
#[test]
fn comments_of_other_programs_are_read() {
    let bytes = encoded(&scene(0), SceneFormat::Ply, 3);
    for (comments, expected) in [
        ("comment SplatRenderMode: mip", true),
        ("comment SPLATRENDERMODE:  MIP  ", true),
        ("comment SplatRenderMode: default", false),
        ("comment SplatRenderMode: banana", false),
        ("comment antialiased 1", true),
        ("comment antialiased 0", false),
        ("comment antialiased 1\ncomment SplatRenderMode: default", false),
        ("comment SplatRenderMode: default\ncomment antialiased 1", true),
        ("comment made with SplatRenderMode: mip", false),
    ] {
        let start = b"ply\n";
        let changed = [start, comments.as_bytes(), b"\n", &bytes[start.len()..]].concat();
        assert_eq!(Scene::decode(&changed, None).unwrap().antialiased, expected, "{comments}");
    }
}
