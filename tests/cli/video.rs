//! Videos, by fake ffmpeg programs or an installed one.
#![cfg(unix)]

use crate::{
    Folder,
    cameras::{COPIES, OPTIONS_3, colmap, installed, model},
};
use glam::{DMat3, DVec3};
use std::path::PathBuf;
use zipsplat::types::{Camera, poses::CaptureView};

/// Of 6 frames, 1, 2 and 4 are the sharpest of their thirds.
#[test]
fn videos_become_their_sharpest_frames() {
    let folder = Folder::new();
    let noise =
        |frame: usize, i: usize| ((i * 2_654_435_761) >> 7) as u8 / if [1, 2, 4].contains(&frame) { 1 } else { 8 };
    let gray: Vec<u8> = (0..6).flat_map(|frame| (0..512 * 512).map(move |i| noise(frame, i))).collect();
    folder.write("gray", gray);
    let ppm = |shade: u8| [b"P6\n16 8\n255\n".as_slice(), &[shade; 3 * 16 * 8]].concat();
    folder.write("ppm", [ppm(40), ppm(90), ppm(200)].concat());
    let here = folder.line("@");
    let text = |gray: &str, ppm: &str| {
        format!(
            "#!/bin/sh\n[ \"$1\" = -version ] && exit 0\necho \"$@\" >>'{here}/ffmpeg.args'\ncase \"$*\" in *rawvideo*) {gray};; *ppm*) {ppm};; esac\n"
        )
    };
    let cats = text(&format!("cat '{here}/gray'"), &format!("cat '{here}/ppm'"));
    folder.script("ffmpeg", &cats);
    folder.write("clip.MP4", "a video");
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    let line = |ffmpeg: &str| format!("reconstruct @/clip.MP4 --views 3 --ffmpeg @/{ffmpeg} {micro} -o @/scene.ply");
    let before = folder.names();
    assert_eq!(folder.run(&(line("ffmpeg") + " --json")).json()["photos"], 3);
    let made: Vec<String> = folder.names().into_iter().filter(|name| !before.contains(name)).collect();
    assert_eq!(made, ["ffmpeg.args", "scene.ply"]);
    let args = folder.text("ffmpeg.args");
    assert!(args.contains("select='(eq(n,1)+(eq(n,2)+eq(n,4)))'"), "{args}");
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", COPIES]);
    let camera = zipsplat_tests::scenes::camera(16, 8);
    let moved = Camera { pose: zipsplat::types::Pose { rotation: DMat3::IDENTITY, translation: DVec3::X }, ..camera };
    model(&folder.path("colmap.model/0"), &[("0/000000.jpg", &camera), ("0/000002.jpg", &moved)]);
    let cameras = "cameras @/clip.MP4 --views 3 --ffmpeg @/ffmpeg --colmap @/colmap -o @/transforms.json";
    folder.run(cameras).success();
    let poses = folder.capture("transforms.json");
    let names: Vec<&str> = poses.frames.iter().map(|frame| frame.name.as_str()).collect();
    assert_eq!(names, ["frames/clip-00001.jpg", "frames/clip-00004.jpg"]);
    let shade = |frame: &CaptureView| -> PathBuf { frame.photo.clone().expect("the frame was kept") };
    let photo = zipsplat::types::Image::open(shade(&poses.frames[1])).expect("a photo");
    assert!(photo.rgb.iter().all(|value| value.abs_diff(200) < 3) && (photo.width, photo.height) == (16, 8));
    folder.run(cameras).fails(3, &["folder for frames", "frames", "does not exist yet"]);
    folder.run(&cameras.replace("transforms", "other")).success();
    assert_eq!(folder.capture("other.json").frames[0].name, "other.frames/clip-00001.jpg");
    folder.run(&format!("{cameras} --overwrite")).success();
    assert!(!folder.path("frames/clip-1-00001.jpg").exists(), "frames of the same video are replaced");
    folder.remove("scene.ply");
    folder.script("short", &cats.replace("/ppm'", "/ppm' | head -c 400"));
    folder.script("says", &text("echo 'moov atom not found' >&2; exit 1", ""));
    folder.script("nothing", &text("echo '[mov @ 0x7f] error in track' >&2", ""));
    folder.script("sound", &text("echo \"Stream map '0:v:0' matches no streams.\" >&2; exit 1", ""));
    let complains = format!("echo '[h264 @ 0x7f] partial file' >&2; cat '{here}/gray'");
    folder.script("damaged", &text(&complains, &format!("cat '{here}/ppm'")));
    let before = folder.names();
    folder.run(&line("short")).fails(1, &["short"]);
    folder.run(&line("says")).fails(3, &["clip.MP4", "ffmpeg cannot read it: moov atom not found"]);
    folder.run(&line("nothing")).fails(3, &["clip.MP4", "no frame", ": error in track"]);
    folder.run(&line("sound")).fails(3, &["clip.MP4", "no pictures in it"]);
    folder.run(&line("absent")).fails(3, &["ffmpeg", "absent", "an installed ffmpeg"]);
    folder.run(&line("ffmpeg").replace("clip", "none")).fails(3, &["none.MP4", "No such file"]);
    assert_eq!(folder.names(), before);
    let outcome = folder.run(&line("damaged"));
    assert!(
        outcome.err.contains("clip.MP4: ffmpeg reads 6 frames and finds the file damaged: partial file"),
        "{}",
        outcome.err
    );
    outcome.success();
}

#[test]
fn ffmpeg_itself_gives_frames_turned_as_the_file_says() {
    if !installed("ffmpeg", "ffmpeg_itself_gives_frames_turned_as_the_file_says") {
        return;
    }
    let folder = Folder::new();
    let ffmpeg = |line: &str| {
        let line = folder.line(line);
        let run = std::process::Command::new("ffmpeg").args(["-loglevel", "error"]).args(line.split(' ')).status();
        assert!(run.expect("ffmpeg runs").success(), "{line}");
    };
    ffmpeg("-f lavfi -i testsrc=duration=1:size=64x48:rate=10 -c:v mpeg4 @/plain.mp4");
    ffmpeg("-i @/plain.mp4 -c copy -metadata:s:v rotate=90 @/turned.mp4");
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", COPIES]);
    let camera = |width, height| zipsplat_tests::scenes::camera(width, height);
    for (clip, width, height) in [("plain", 64, 48), ("turned", 48, 64)] {
        model(&folder.path("colmap.model/0"), &[("0/000004.jpg", &camera(width, height))]);
        let line = format!("cameras @/{clip}.mp4 --views 5 --colmap @/colmap -o @/{clip}.json --overwrite --json");
        let json = folder.run(&line).json();
        assert_eq!((json["photos"].as_u64(), json["registered"].as_u64()), (Some(5), Some(1)), "{json}");
    }
    folder.make("day");
    std::fs::copy(folder.path("plain.mp4"), folder.path("day/plain.mp4")).expect("a copy");
    let line = "cameras @/plain.mp4 @/day/plain.mp4 --views 6 --colmap @/colmap -o @/days/c.json --json";
    model(&folder.path("colmap.model/0"), &[("0/000004.jpg", &camera(64, 48))]);
    folder.run(line).json();
    let frames = std::fs::read_dir(folder.path("days/c.frames")).expect("frames");
    let mut names: Vec<String> = frames.map(|frame| frame.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!(names.len(), 12);
    assert!(names[..6].iter().all(|name| name.starts_with("plain-1-0")), "{names:?}");
    assert!(names[6..].iter().all(|name| name.starts_with("plain-2-0")), "{names:?}");
    folder.write("list.mp4", "ffconcat version 1.0\nfile plain.mp4\n");
    let line = "cameras @/list.mp4 --views 5 --colmap @/colmap -o @/list.json --overwrite";
    folder.run(line).fails(3, &["list.mp4", "ffmpeg cannot read it"]);
}
