use crate::{Folder, cancel::cancelled_when, names, raw_command};
use glam::{DMat3, DVec3};
use image::{AnimationDecoder, Delay, codecs::png::PngDecoder};
use std::{fs::File, io::BufReader, sync::atomic::AtomicBool};
use zipsplat::types::{Camera, Image, Intrinsics, Pose, SaveOptions, Scene, World, poses::write_transforms};
use zipsplat_tests::{photos::with_orientation, scenes};

/// Three cameras are of one size (`cameras.json`), or several (`sizes.json`).
fn folder() -> Folder {
    let folder = Folder::new();
    folder.scatter("scene.ply", 200, 1, 0.2);
    let camera = |x: f64, width: u32| Camera {
        pose: Pose { translation: [x, 0.0, -x * x].into(), ..Pose::IDENTITY },
        ..scenes::camera(width, 30)
    };
    let names = ["c/a.png", "c/b.png", "c/c.png"];
    for (file, width) in [("cameras.json", 40), ("sizes.json", 50)] {
        let cameras = [camera(0.0, 40), camera(0.5, width), camera(-0.5, 40)];
        write_transforms(folder.path(file), &cameras, &names).expect("cameras");
    }
    folder
}

fn pictures(folder: &Folder, name: &str) -> Vec<Vec<u8>> {
    let numbered = |name: &String| name.starts_with(|c: char| c.is_ascii_digit());
    let files = names(&folder.path(name)).into_iter().filter(numbered);
    files.map(|file| Image::open(folder.path(name).join(file)).expect("a picture").rgb).collect()
}

const RENDER: &str = "render @/scene.ply";

#[test]
fn every_path_draws_its_pictures() {
    let folder = folder();
    let lines = [
        ("--spline @/cameras.json", (40, 30)),
        ("--spline @/sizes.json --loop", (40, 30)),
        ("--spline @/cameras.json --relative-to x/b.png --size 20x20", (20, 20)),
        ("--ellipse @/cameras.json", (40, 30)),
        ("--dolly --travel -0.5 --size 24x16", (24, 16)),
        ("--dolly --dolly-zoom --fov 90 --size 24x16", (24, 16)),
    ];
    for (i, (path, size)) in lines.into_iter().enumerate() {
        folder.run(&format!("{RENDER} {path} --frames 5 -o @/{i}")).success();
        let pictures = pictures(&folder, &i.to_string());
        assert_eq!((pictures.len(), pictures[0].len()), (5, 3 * (size.0 * size.1) as usize), "{path}");
        assert!(pictures.windows(2).all(|pair| pair[0] != pair[1]), "{path}");
    }
    folder.run(&format!("{RENDER} --cameras @/cameras.json -o @/given")).success();
    let (given, spline) = (pictures(&folder, "given"), pictures(&folder, "0"));
    assert_eq!([&given[0], &given[2]], [&spline[0], &spline[4]], "a spline ends at its last camera");
}

#[test]
fn an_orbit_takes_its_up_from_cameras() {
    let folder = folder();
    let tilted = |degrees: f64| Camera {
        pose: Pose { rotation: DMat3::from_rotation_x(degrees.to_radians()), ..Pose::IDENTITY },
        ..scenes::camera(40, 30)
    };
    let names = ["a.png", "b.png", "c.png"];
    let orbit = |name: &str, degrees: [f64; 3]| {
        write_transforms(folder.path("up.json"), &degrees.map(tilted), &names).expect("cameras");
        let line = format!("{RENDER} --orbit=@/up.json --fov 60 --frames 4 --size 40x30 -o @/{name}");
        folder.run(&line).success();
        pictures(&folder, name)
    };
    folder.run(&format!("{RENDER} --orbit --frames 4 --size 40x30 -o @/plain")).success();
    let plain = pictures(&folder, "plain");
    let close =
        |a: &[Vec<u8>], b: &[Vec<u8>]| a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| a.abs_diff(*b) < 3);
    assert!(close(&orbit("level", [20.0, -20.0, 0.0]), &plain), "the mean up is level");
    assert!(!close(&orbit("tilted", [20.0; 3]), &plain), "the mean up is tilted");
}

#[test]
fn photos_stored_on_their_sides_are_upright() {
    let folder = folder();
    let jpeg = crate::photo(30, 40, 0).jpeg(90).expect("a photo");
    folder.write("side.jpg", with_orientation(&jpeg, 6));
    let upright = scenes::camera(40, 30);
    write_transforms(folder.path("side.json"), &[upright.turned(3)], &["side.jpg"]).expect("cameras");
    write_transforms(folder.path("upright.json"), &[upright], &["none.jpg"]).expect("cameras");
    let drawn = |path: &str| {
        folder.run(&format!("{RENDER} {path} --frames 4 -o @/out")).success();
        (Image::size(folder.path("out/000.png")).expect("a picture"), pictures(&folder, "out"))
    };
    assert!(drawn("--orbit=@/side.json") == drawn("--orbit=@/upright.json"), "an orbit");
    folder.run(&format!("{RENDER} --cameras @/side.json -o @/own")).success();
    assert_eq!(Image::size(folder.path("own/000.png")).expect("a picture"), (30, 40), "the camera itself");
    let frames = folder.capture("side.json").frames;
    let scene = Scene::open(folder.path("scene.ply")).expect("a scene");
    let world = World::of_first(&[&frames[0]]);
    scene.save_in(folder.path("scene.ply"), &SaveOptions::default(), world.as_ref()).expect("saved");
    let (size, pictures) = drawn("--wiggle");
    assert_eq!((size, pictures.len()), ((40, 30), 4));
    // Cameras that look down do not agree on an up in the picture.
    let drawn_with = |up: Option<DVec3>| {
        let world = World { up, turns: 0, ..world.clone().expect("a world") };
        scene.save_in(folder.path("scene.ply"), &SaveOptions::default(), Some(&world)).expect("saved");
        drawn("--wiggle")
    };
    assert!(drawn_with(Some(DVec3::Y)) == drawn_with(None), "a path of downward cameras");
}

#[test]
fn a_spline_visits_scattered_cameras_by_nearness() {
    let folder = folder();
    let camera = |x: f64| Camera {
        pose: Pose { translation: [x, 0.0, -0.2].into(), ..Pose::IDENTITY },
        ..scenes::camera(40, 30)
    };
    let drawn = |name: &str, at: [f64; 5]| {
        let names = ["a.png", "b.png", "c.png", "d.png", "e.png"];
        write_transforms(folder.path("path.json"), &at.map(camera), &names).expect("cameras");
        let outcome = folder.run(&format!("{RENDER} --spline @/path.json --frames 5 -o @/{name}"));
        (outcome.err.contains("by nearness"), pictures(&folder, name))
    };
    let (noted, path) = drawn("path", [0.0, 0.1, 0.2, 0.3, 0.4]);
    let (reordered, scattered) = drawn("scattered", [0.0, 0.3, 0.1, 0.4, 0.2]);
    assert!(!noted && reordered && path == scattered, "{noted} {reordered}");
}

#[test]
fn lists_of_matrices_take_the_lens_that_is_given() {
    let folder = folder();
    let one = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    folder.write("list.json", format!("[{one}, {one}]"));
    folder.run(&format!("{RENDER} --cameras @/list.json --size 32x24 --fov 90 -o @/list")).success();
    let lens = Intrinsics { width: 32, height: 24, fx: 16.0, fy: 16.0, cx: 16.0, cy: 12.0 };
    let camera = Camera { intrinsics: lens, pose: Pose::IDENTITY };
    write_transforms(folder.path("same.json"), &[camera; 2], &["a", "b"]).expect("cameras");
    folder.run(&format!("{RENDER} --cameras @/same.json -o @/same")).success();
    assert_eq!(pictures(&folder, "list"), pictures(&folder, "same"));
    let narrow = Camera { intrinsics: Intrinsics { fx: 40.0, fy: 40.0, ..lens }, ..camera };
    write_transforms(folder.path("narrow.json"), &[narrow; 2], &["a", "b"]).expect("cameras");
    folder.run(&format!("{RENDER} --cameras @/narrow.json --fov 90 -o @/wide")).success();
    assert_eq!(pictures(&folder, "list"), pictures(&folder, "wide"));
    let orbit = folder.run(&format!("{RENDER} --orbit --relative-to a -o @/orbit"));
    orbit.fails(3, &["--relative-to: found a with --orbit"]);
}

#[test]
fn a_gif_has_every_picture_at_its_rate() {
    let folder = folder();
    let line = format!("{RENDER} --orbit --frames 11 --size 37x23 --fps 30 --video @/a.GIF -o @/out");
    folder.run(&line).success();
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(File::open(folder.path("a.GIF")).expect("a file")).expect("a GIF");
    assert_eq!((decoder.width(), decoder.height(), decoder.repeat()), (37, 23, gif::Repeat::Infinite));
    let mut delays = Vec::new();
    let truth = pictures(&folder, "out");
    while let Some(frame) = decoder.read_next_frame().expect("a frame") {
        let difference = |picture: &Vec<u8>| {
            let rgb = frame.buffer.chunks_exact(4).flat_map(|pixel| &pixel[..3]);
            rgb.zip(picture).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / picture.len() as f64
        };
        let differences: Vec<f64> = truth.iter().map(difference).collect();
        // 256 colors for 851 mostly different pixels.
        let own = differences[delays.len()];
        assert!(own < 8.0, "{own} levels");
        assert!(
            differences.iter().enumerate().all(|(i, other)| i == delays.len() || *other > 1.5 * own),
            "{differences:?}"
        );
        delays.push(frame.delay);
    }
    assert_eq!(delays, [3, 4, 3, 3, 4, 3, 3, 4, 3, 3, 4], "11 pictures in 0.37 s");
}

#[test]
fn an_animated_png_has_every_pixel() {
    let folder = folder();
    folder.run(&format!("{RENDER} --wiggle --frames 10 --size 37x23 --fps 25 --video @/a.apng -o @/out")).success();
    folder.run(&format!("{RENDER} --wiggle --frames 10 --size 37x23 --video @/b.png")).success();
    let truth = pictures(&folder, "out");
    for (file, delay) in
        [("a.apng", Delay::from_numer_denom_ms(1000, 25)), ("b.png", Delay::from_numer_denom_ms(1000, 30))]
    {
        let reader = BufReader::new(File::open(folder.path(file)).expect("a file"));
        let decoder = PngDecoder::new(reader).expect("a PNG").apng().expect("an animated one");
        let frames = decoder.into_frames().collect_frames().expect("frames");
        let rgb = |frame: &image::Frame| image::DynamicImage::from(frame.buffer().clone()).into_rgb8().into_raw();
        assert!(frames.iter().map(rgb).eq(truth.iter().cloned()), "{file}");
        let (a, b) = (frames[0].delay().numer_denom_ms(), delay.numer_denom_ms());
        assert_eq!(a.0 * b.1, b.0 * a.1, "{file}");
    }
}

#[test]
fn raw_frames_are_the_pictures() {
    let folder = folder();
    let path = "--orbit --frames 10 --size 37x23";
    folder.run(&format!("{RENDER} {path} -o @/out")).success();
    let line = folder.line(&format!("{RENDER} {path} -o -"));
    let (code, out, err) = raw_command(&line, &AtomicBool::new(false));
    assert_eq!(code, 0, "{err}");
    assert_eq!(out.len(), 10 * 37 * 23 * 3);
    assert_eq!(out, pictures(&folder, "out").concat());
    assert!(err.contains("size: 37x23"), "{err}");
}

/// One test: starting a program while writing one can fail.
#[test]
#[cfg(unix)]
fn mp4_is_piped_to_ffmpeg() {
    let folder = folder();
    let script = |name: &str, body: &str| {
        let start = "#!/bin/sh\n[ \"$1\" = -version ] && exit 0\nfor out; do :; done\nout=${out#file:}";
        folder.script(name, &format!("{start}\n{body}\n"));
    };
    script("copies", "echo \"$@\" >\"$0.args\"\ncat >\"$out\"");
    script("fails", "echo bytes >\"$out\"\ncat >/dev/null\necho 'Unknown encoder' >&2\nexit 7");
    script("stops", "exec <&-\nsleep 0.2\necho bytes >\"$out\"\necho 'No space' >&2\nexit 1");
    script("silent", "cat >/dev/null\nexit 7");
    folder.script("broken", "#!/bin/sh\nexit 3\n");

    // No author tag.
    let line = |program: &str| {
        format!("{RENDER} --orbit --frames 20 --size 37x23 --fps 24 --ffmpeg @/{program} --video @/out.mp4 --overwrite")
    };
    folder.run(&format!("{RENDER} --orbit --frames 20 --size 37x23 -o @/out")).success();
    folder.run(&line("copies")).success();
    let piped = folder.read("out.mp4");
    assert_eq!(piped, pictures(&folder, "out").concat());
    let args = folder.text("copies.args");
    assert!(args.contains("-f rawvideo -pix_fmt rgb24 -s 37x23 -framerate 24 -i -"), "{args}");
    assert!(args.contains("-metadata comment=zipsplat"), "{args}");

    script("sleeps", "cat >/dev/null\nexec sleep 60");
    cancelled_under_way(&folder, &line("sleeps"));
    let before = folder.names();
    folder.run(&line("fails")).fails(1, &["fails", "Unknown encoder"]);
    folder.run(&line("stops")).fails(1, &["stops", "No space"]);
    folder.run(&line("silent")).fails(1, &["silent", "exit status: 7"]);
    folder.run(&line("absent")).fails(3, &["ffmpeg", "absent", "an installed ffmpeg", ".gif"]);
    folder.run(&line("broken")).fails(3, &["ffmpeg", "broken", "exit status: 3"]);
    assert_eq!(folder.names(), before);
    assert_eq!(folder.read("out.mp4"), piped);
}

#[test]
fn unusable_requests_leave_no_file() {
    let folder = folder();
    let before = folder.names();
    for (line, words) in [
        ("--orbit --video @/out.webp", ["--video", ".gif, .apng"]),
        ("--orbit --video @/out", ["--video", ".mp4"]),
        ("--orbit --video @/absent/out.gif", ["output folder", "absent"]),
        ("--orbit --fps 60 --video @/out.gif", ["--fps of a GIF", "50"]),
        ("--orbit --depth --video @/out.gif", ["--depth, --alpha", "-o FOLDER"]),
        ("--orbit --alpha -o -", ["--depth, --alpha", "-o FOLDER"]),
        ("--cameras @/sizes.json --video @/out.gif", ["size of camera 1: found 50x30", "40x30"]),
        ("--cameras @/sizes.json -o -", ["size of camera 1", "--size"]),
        ("--orbit --size 2x0 --video @/out.gif", ["camera 0", "size"]),
        ("--orbit --size 32769x1 --video @/out.gif", ["size of camera 0", "32768"]),
        ("--dolly --travel 1 -o @/out", ["travel", "below 1"]),
        ("--ellipse @/scene.ply -o @/out", ["poses", "transforms.json"]),
        ("--spline @/absent.json -o @/out", ["absent.json", "No such file"]),
    ] {
        let (code, out, err) = raw_command(&folder.line(&format!("{RENDER} {line}")), &AtomicBool::new(false));
        assert_eq!((code, out.len()), (3, 0), "{line}: {err}");
        assert!(words.iter().all(|word| err.contains(word)), "{line}: {err}");
        assert_eq!(folder.names(), before, "{line}");
    }
    for line in [
        "--orbit",
        "--orbit --loop -o @/out",
        "--cameras @/cameras.json --dolly-zoom -o @/out",
        "--wiggle --travel 0.2 -o @/out",
        "--orbit --fps 0 --video @/a.gif",
    ] {
        assert_eq!(folder.run(&format!("{RENDER} {line}")).code, 2, "{line}");
    }
    let cancelled = AtomicBool::new(true);
    for line in ["--orbit --video @/out.gif", "--orbit --video @/out.apng", "--orbit -o -"] {
        let (code, out, _) = raw_command(&folder.line(&format!("{RENDER} {line}")), &cancelled);
        assert_eq!((code, out.len()), (130, 0), "{line}");
    }
    assert_eq!(folder.names(), before);
}

#[track_caller]
fn cancelled_under_way(folder: &Folder, line: &str) {
    let before = folder.names();
    let has_begun = || folder.names().iter().any(|name| name.starts_with(".zipsplat-"));
    let code = cancelled_when(&folder.line(line), has_begun).code;
    assert_eq!(code, 130, "{line}");
    assert_eq!(folder.names(), before, "{line}");
}

#[test]
fn cancelling_under_way_leaves_no_file() {
    let folder = folder();
    for file in ["out.gif", "out.apng"] {
        cancelled_under_way(&folder, &format!("{RENDER} --orbit --frames 2000 --size 37x23 --video @/{file}"));
    }
}
