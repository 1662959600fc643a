//! HEIC photos, by fake ffmpeg programs.
#![cfg(unix)]

use crate::Folder;
use std::fs;
use zipsplat::types::Image;

const START: &[u8] = b"\0\0\0\x18ftypheic\0\0\0\0";
const LINE: &str = "--weights @/micro.safetensors --input-size 28x28 -o @/scene.ply --ffmpeg @/";

/// Two HEIC photos, and fake programs: name, probe output, decoder output.
fn phone(programs: &[(&str, &str, &str)]) -> Folder {
    let folder = Folder::new();
    for name in ["phone/IMG_1.HEIC", "phone/IMG_2.heic"] {
        folder.write(name, START);
    }
    folder.write("ppm", [b"P6\n16 8\n255\n".as_slice(), &[90; 3 * 16 * 8]].concat());
    for (name, info, makes) in programs {
        let text = format!(
            "#!/bin/sh\n[ \"$1\" = -version ] && exit 0\ncase \"$*\" in *ppm*) {makes};; *) {info} >&2; exit 1;; esac\n"
        );
        folder.script(name, &text.replace('@', &folder.line("@")));
    }
    folder
}

const ONE: &str = "echo '  Stream #0:0: Video: hevc, 16x8'";
const TILES: &str = "echo '  Stream #0:0: Video: hevc'; echo '  Stream #0:1: Video: hevc'";
const GRID: &str =
    "echo '  Stream group #0:0: Tile Grid: hevc'; echo '  Stream #0:0: Video: hevc'; echo '  Stream #0:1: Video: hevc'";
const GIVES: &str = "cat '@/ppm'";

#[test]
fn heic_pictures_are_photos() {
    let folder = phone(&[("one", &ONE.replace("; ", " >&2; "), GIVES), ("grid", &GRID.replace("; ", " >&2; "), GIVES)]);
    let before = folder.names();
    for program in ["one", "grid"] {
        for photos in ["@/phone", "@/phone/IMG_2.heic @/photos/1.png", "@/phone --recursive"] {
            assert_eq!(folder.run(&format!("reconstruct {photos} --json {LINE}{program}")).json()["photos"], 2);
            folder.remove("scene.ply");
        }
    }
    assert_eq!(folder.names(), before);
    let outcome = folder.run(&format!("reconstruct @/phone/IMG_1.HEIC @/photos --json {LINE}one"));
    assert_eq!(outcome.json()["photos"], 3);
    fs::copy(folder.path("photos/1.png"), folder.path("phone/IMG_1.png")).expect("copied");
    let outcome = folder.run(&format!("reconstruct @/phone --json {LINE}one"));
    assert!(
        outcome.err.contains("1 file left out, HEIC beside a photo of the same name: IMG_1.HEIC"),
        "{}",
        outcome.err
    );
    assert_eq!(outcome.json()["photos"], 2);
}

#[test]
fn heic_pictures_stay_as_photos_where_cameras_name_them() {
    use crate::cameras::{COPIES, OPTIONS_3, colmap, model};
    let folder = phone(&[("one", ONE, GIVES)]);
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", COPIES]);
    let camera = zipsplat_tests::scenes::camera(16, 8);
    model(&folder.path("colmap.model/0"), &[("0/000000.jpg", &camera), ("0/000001.jpg", &camera)]);
    folder.run("cameras @/phone --ffmpeg @/one --colmap @/colmap -o @/transforms.json").success();
    let names: Vec<String> = folder.capture("transforms.json").frames.into_iter().map(|f| f.name).collect();
    assert_eq!(names, ["frames/IMG_1.jpg", "frames/IMG_2.jpg"]);
    let photo = Image::open(folder.path("frames/IMG_2.jpg")).expect("a photo");
    assert!(photo.rgb.iter().all(|value| value.abs_diff(90) < 3) && (photo.width, photo.height) == (16, 8));
}

#[test]
fn pictures_that_ffmpeg_cannot_read_name_who_can() {
    let says = "echo '[mov @ 0x1] moov atom not found' >&2; exit 1";
    let folder =
        phone(&[("old", ONE, says), ("tiles", &TILES.replace("; ", " >&2; "), GIVES), ("none", ONE, "exit 0")]);
    let before = folder.names();
    for (program, why) in [
        ("old", "moov atom not found"),
        ("tiles", "finds tiles"),
        ("none", "gives no picture"),
        ("absent", "No such file"),
    ] {
        let advice = folder.line("`heif-convert @/phone/IMG_1.HEIC @/phone/IMG_1.HEIC.jpg`");
        let words = ["IMG_1.HEIC", "a HEIC picture", &advice, why];
        folder.run(&format!("reconstruct @/phone {LINE}{program}")).fails(3, &words);
        assert_eq!(folder.names(), before);
    }
}
