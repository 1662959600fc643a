use crate::stream::Header;
use zipsplat_tests::command::zipsplat;

#[test]
fn writes_a_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene");
    let (code, out, err) = zipsplat(&format!("scene --seed 7 --views 3 --size 24x16 --json -o {}", path.display()));
    assert_eq!(code, 0, "{err}");
    let json: serde_json::Value = serde_json::from_slice(&out).expect("JSON");
    let json = &json["result"];
    assert_eq!((&json["seed"], &json["views"]), (&7.into(), &3.into()));
    for file in ["images/002.png", "depth/002.npy", "transforms.json", "scene.json"] {
        assert!(path.join(file).is_file(), "{file} is missing");
    }
}

#[test]
fn streams_to_standard_output_and_to_a_file() {
    let (code, out, err) = zipsplat("scene --shards - --scenes 2 --first-seed 5 --views 2 --size 16x16");
    assert_eq!(code, 0, "{err}");
    let header = Header::read(out.as_slice()).expect("a header");
    assert_eq!((header.scenes, out.len()), (2, 36 + 2 * header.scene_bytes()));
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scenes.bin");
    let line = format!("scene --shards {} --scenes 2 --seed 5 --views 2 --size 16x16", path.display());
    assert_eq!(zipsplat(&line).0, 0);
    assert_eq!(std::fs::read(&path).expect("a file"), out);
}

#[test]
fn refuses_what_it_cannot_do() {
    for (line, code, word) in [
        ("scene --seed 1", 2, "--output"),
        ("scene -o x --shards -", 2, "--shards"),
        ("scene -o x --size 12", 2, "WIDTHxHEIGHT"),
        ("scene -o x --views 0", 3, "views"),
        ("scene -o x --size 0x8", 3, "size"),
        ("scene -o x --size 8x5000", 3, "size"),
        ("scene -o x --textures missing-folder", 3, "manifest.json"),
        ("scene --shards missing-folder/s.bin", 3, "--scenes"),
        ("scene --shards missing-folder/s.bin --scenes 1", 3, "missing-folder"),
    ] {
        let (found, _, err) = zipsplat(line);
        assert_eq!(found, code, "{line}: {err}");
        assert!(err.contains(word), "{line}: {err}");
    }
}
