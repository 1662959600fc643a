use crate::{Folder, zipsplat};
use zipsplat::types::poses::write_transforms;
use zipsplat_tests::scenes;

#[track_caller]
fn refused(folder: &Folder, line: &str, code: u8, words: &[&str]) {
    let before = folder.names();
    folder.run(line).fails(code, words);
    assert_eq!(folder.names(), before, "{line}");
}

const MICRO: &str = "--weights @/micro.safetensors --input-size 28x28 -o @/out.ply";

#[test]
fn photos() {
    let folder = Folder::new();
    let png = folder.read("photos/1.png");
    folder.write("cut.png", &png[..png.len() / 2]);
    folder.write("text.jpg", "not a photo");
    folder.make("empty");
    for (photos, words) in [
        ("@/cut.png", ["cut.png", ""]),
        ("@/photos @/text.jpg", ["text.jpg", "no PNG, JPEG or WebP"]),
        ("@/absent.png", ["absent.png", "No such file"]),
        ("@/empty", ["photos in", "found none"]),
    ] {
        refused(&folder, &format!("reconstruct {photos} {MICRO}"), 3, &words);
    }
    let many = vec!["@/photos"; 97].join(" ");
    let folder = folder.with_depth();
    let many = format!("reconstruct {many} --weights @/da3.safetensors -o @/out.ply");
    refused(&folder, &many, 3, &["views", "194", "1 to 192", "--views N"]);
    for (name, start, kind, advice) in [
        ("a.HEIC", &b"\0\0\0\x18ftypheic\0\0\0\0"[..], "a HEIC picture", "`heif-convert @/a.HEIC @/a.HEIC.jpg`"),
        ("b.jpg", b"\0\0\0\x18ftypmif1\0\0\0\0", "a HEIC picture", "`heif-convert @/b.jpg @/b.jpg.jpg`"),
        ("c.avif", b"\0\0\0\x18ftypavif", "an AVIF picture", "`magick @/c.avif @/c.avif.png`"),
        ("d.mp4", b"\0\0\0\x18ftypisom\0\0\0\0", "a video (MP4", "`ffmpeg -i @/d.mp4 -vf fps=2 '@/%03d.jpg'`"),
        ("e.mov", b"\0\0\0\x18ftypqt  \0\0\0\0", "a video (MP4", "`ffmpeg -i @/e.mov"),
        ("f.avi", b"RIFF\0\0\0\0AVI LIST", "a video (AVI)", "`ffmpeg -i @/f.avi"),
        ("g.mkv", b"\x1a\x45\xdf\xa3\0\0\0\0", "a video (Matroska", "`ffmpeg -i @/g.mkv"),
        ("h.bmp", b"BM\x46\0\0\0\0\0\0\0\x36\0", "a BMP picture", "`magick @/h.bmp @/h.bmp.png`"),
        ("i.tif", b"II*\0\x08\0\0\0\0\0\0\0", "a TIFF or", "`magick @/i.tif @/i.tif.png`"),
        ("j.tiff", b"MM\0*\0\0\0\x08\0\0\0\0", "a TIFF or", "`magick @/j.tiff @/j.tiff.png`"),
        ("k.gif", b"GIF89a\x01\0\x01\0\0\0", "a GIF picture", "`magick '@/k.gif[0]' @/k.gif.png`"),
    ] {
        folder.write(name, start);
        let advice = folder.line(advice);
        // ffmpeg reads videos.
        if !kind.contains("video") {
            refused(&folder, &format!("reconstruct @/photos @/{name} {MICRO}"), 3, &[name, kind, &advice]);
        }
        folder.write(&format!("phone/{name}"), start);
        if name != "b.jpg" {
            let below = advice.replace(&folder.line("@/"), &folder.line("@/phone/"));
            refused(&folder, &format!("reconstruct @/phone {MICRO}"), 3, &[name, kind, &below]);
        }
        for name in [name.to_owned(), format!("phone/{name}")] {
            folder.remove(&name);
        }
    }
}

#[test]
fn json_has_errors_as_objects() {
    let folder = Folder::new();
    let error = |line: &str, code: u8| -> serde_json::Value {
        let outcome = folder.run(line);
        assert_eq!((outcome.code, outcome.out.as_str(), outcome.err.lines().count()), (code, "", 1), "{}", outcome.err);
        let json: serde_json::Value = serde_json::from_str(&outcome.err).expect("JSON");
        assert_eq!(json["exit_code"], code);
        json
    };
    let json = error("convert @/absent.ply --json", 3);
    assert_eq!(json["kind"], "io");
    assert!(json["error"].as_str().is_some_and(|text| text.contains("absent.ply: No such file")), "{json}");
    assert_eq!(error("--json info @/photos/1.png", 3)["kind"], "argument");
    assert_eq!(error("doctor --device nonesuch --json", 4)["kind"], "no_device");
    // Also digits of a driver's version: "llvmpipe (LLVM 19.1.7, 256 bits)".
    for digits in ["256", "9", "7", "99999999999999999999"] {
        let json = error(&format!("doctor --device {digits} --json"), 4);
        assert!(json["error"].as_str().is_some_and(|text| text.contains("an index") && text.contains("0: ")), "{json}");
    }
    let json = error("render --json", 2);
    assert_eq!(json["kind"], "usage");
    assert!(json["error"].as_str().is_some_and(|text| text.contains("Usage: ")), "{json}");
    assert!(folder.run("render --json --help").success().contains("exit_code"));
}

#[test]
fn numbers() {
    let folder = Folder::new();
    for ratio in ["0", "1.5", "nan", "inf", "-0.5"] {
        refused(&folder, &format!("reconstruct @/photos --ratio={ratio} {MICRO}"), 3, &["ratio", "(0, 1]"]);
    }
    for line in ["reconstruct @/photos -o @/out.ply", "eval @/absent -o @/out", "bench tradeoff @/absent -o @/report"] {
        let line = format!("{line} --weights @/micro.safetensors --input-size 28x28 --views 2 --kv-pool 5");
        folder.run(&line).fails_usage();
    }
    for size in ["30x28", "28x0", "4294967282x14"] {
        let line = format!("reconstruct @/photos --weights @/micro.safetensors --input-size {size} -o @/out.ply");
        refused(&folder, &line, 3, &["size of the views"]);
    }
    folder.run("reconstruct --dry-run --views 0 --weights seeded:vits").fails_usage();
    refused(&folder, "reconstruct --dry-run --weights seeded:vits", 3, &["photos", "--views"]);
    for line in ["reconstruct @/photos", "eval @/absent", "reconstruct --dry-run --views 2"] {
        let line = format!("{line} --weights @/micro.safetensors --max-gaussians-per-token 5 -o @/out.ply");
        refused(&folder, &line, 3, &["--max-gaussians-per-token: found 5", "1 to 4"]);
    }
    for keep in ["5", "4,5"] {
        let line = format!(
            "bench tradeoff @/absent --weights @/micro.safetensors --input-size 28x28 --max-gaussians-per-token {keep} -o @/report"
        );
        refused(&folder, &line, 3, &["--max-gaussians-per-token: found", "1 to 4"]);
    }
    let little = "--weights @/micro.safetensors --input-size 28x28 --max-memory 100K -o @/out.ply";
    refused(
        &folder,
        &format!("reconstruct @/photos {little}"),
        4,
        &["MiB of device memory are missing", "--max-memory allows 100.00 KiB"],
    );
    for device in ["", "--device none "] {
        let planned = folder.run(&format!("{device}reconstruct --dry-run --views 2 {little}"));
        let words = ["a run would be refused", "100.00 KiB"];
        assert!(planned.code == 0 && words.iter().all(|word| planned.err.contains(word)), "{}", planned.err);
    }
}

#[test]
fn remedies_are_named() {
    let folder = Folder::new();
    refused(&folder, "eval @/photos --views 1", 3, &["poses: found", "--cameras colmap"]);
    refused(&folder, "reconstruct @/photos --weights nosuch -o @/out.ply", 3, &["nosuch", "zipsplat, da3-small"]);
    refused(&folder, "depth @/photos --weights nosuch -o @/out", 3, &["nosuch", "zipsplat, da3-small"]);
    let outcome = folder.run("reconstruct @/photos --input-size 100x100 -o @/out.ply");
    assert_eq!((outcome.code, outcome.err.lines().count()), (3, 1), "{}", outcome.err);
}

#[test]
fn new_names_are_aliases() {
    let folder = Folder::new();
    for line in [
        "render @/absent.ply --cameras @/absent.json --point-size 1 --gaussians-per-token 4 --max-memory 1G -o @/out",
        "refine @/absent.ply @/photos --cameras @/absent.json --init scene --max-image-size 64x64 --views-per-step 1 \
         --holdout-views 0 --optimize-cameras --max-gaussians 10 --cameras-out @/c.json -o @/out.ply",
        "eval @/absent --cameras @/absent.json --eval-size 28x28 --full-images --pose-noise 1 --scene-scale 1",
        "cameras @/absent --method colmap --matching sequential --matching-size 640 -o @/c.json",
        "depth @/absent --weights @/absent.safetensors --cameras @/absent.json --max-points 5 --input-size 28 -o @/out",
        "reconstruct @/absent --cameras colmap --token-selection stride --kv-pool 2 --max-gaussians-per-token 1 \
         --input-size 28x28 --precision fp32 --crop crop -o @/out.ply",
    ] {
        let outcome = folder.run(line);
        assert_eq!(outcome.code, 3, "{line}: {}", outcome.err);
    }
}

#[test]
fn short_help_fits_a_screen() {
    for command in ["reconstruct", "refine", "cameras", "depth", "render", "view", "eval", "convert", "doctor"] {
        let [short, long] = ["-h", "--help"].map(|help| zipsplat(&format!("{command} {help}")).success());
        let lines: usize = short.lines().map(|line| line.chars().count().div_ceil(100).max(1)).sum();
        let options = short.lines().filter(|line| line.trim_start().starts_with('-')).count();
        assert!(lines <= 50 && options <= 16, "{command}: {lines} lines, {options} options: {short}");
        for global in ["--device", "--max-memory", "--json", "--quiet"] {
            assert!(short.contains(global), "{command}: {global}");
        }
        assert!(long.lines().count() > short.lines().count() && !long.contains("--poses"), "{long}");
    }
    assert!(!zipsplat("--help").success().contains("Procedural"));
}

#[test]
fn wrong_usage_exits_with_2() {
    let folder = Folder::new();
    let before = folder.names();
    for line in [
        "",
        "paint",
        "reconstruct -o @/out.ply",
        "reconstruct @/photos --ratio half -o @/out.ply",
        "reconstruct @/photos --input-size 252 -o @/out.ply",
        "reconstruct @/photos --token-selection best -o @/out.ply",
        "reconstruct @/photos --precision sloppy -o @/out.ply",
        "render @/scene.ply --orbit --wiggle -o @/out",
        "render @/scene.ply --orbit --background 2,0,0 -o @/out",
        "render @/scene.ply --orbit --frames 0 -o @/out",
        "doctor list --weights seeded:vits",
        "convert @/scene.ply --ratio 0.3",
        "convert @/scene.ply --weights seeded:vits",
        "convert @/scene.ply --max-gaussians-per-token 2",
        "doctor list --drop-invalid",
        "reconstruct @/photos --views 0 -o @/out.ply",
    ] {
        let outcome = folder.run(line);
        assert_eq!((outcome.code, outcome.out.as_str()), (2, ""), "{line}");
        assert!(outcome.err.contains("Usage: ") || outcome.err.contains("error: "), "{line}: {}", outcome.err);
    }
    assert_eq!(folder.names(), before);
    assert_eq!(zipsplat("--version").code, 0);
}

#[test]
fn poses() {
    let folder = Folder::new();
    let cameras = [scenes::camera(40, 30)];
    write_transforms(folder.path("one.json"), &cameras, &["photos/1.png"]).expect("cameras can be written");
    write_transforms(folder.path("none.json"), &[], &[] as &[&str]).expect("cameras can be written");
    folder.write("bad.json", "{\"frames\": 3}");
    folder.scatter("scene.ply", 5, 0, 0.1);
    let reconstruct = |poses: &str| format!("reconstruct @/photos --cameras {poses} {MICRO}");
    refused(
        &folder,
        &format!("reconstruct @/photos/10.png --cameras @/one.json {MICRO}"),
        3,
        &["camera of", "photos/10.png", "found none", "the poses (1): photos/1.png"],
    );
    refused(&folder, &reconstruct("@/bad.json"), 3, &["bad.json", "frames"]);
    refused(&folder, &reconstruct("@/absent.json"), 3, &["absent.json"]);
    refused(&folder, &reconstruct("@/photos"), 3, &["poses", "transforms.json"]);
    refused(&folder, "render @/scene.ply --cameras @/none.json -o @/out", 3, &["cameras of", "at least one"]);
    let elsewhere = "render @/scene.ply --cameras @/one.json --relative-to 7.png -o @/out";
    refused(&folder, elsewhere, 3, &["7.png"]);
    let camera = r#"{"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "file_path": "./train/1"}"#;
    let text = format!("{{\"camera_angle_x\": 0.7, \"frames\": [{camera}]}}");
    folder.write("nerf.json", text);
    let place = folder.line("@/./train/1");
    refused(
        &folder,
        &format!("reconstruct @/photos/1.png --cameras @/nerf.json {MICRO}"),
        3,
        &["camera of", "no w and h", &place],
    );
    refused(&folder, "render @/scene.ply --cameras @/nerf.json -o @/out", 3, &["cameras of", "no w and h", &place]);
    folder.make("blender");
    std::fs::rename(folder.path("nerf.json"), folder.path("blender/transforms_train.json")).expect("renamed");
    let place = folder.line("@/blender/./train/1");
    refused(
        &folder,
        "eval @/blender --views 2 --weights @/micro.safetensors --input-size 28x28",
        3,
        &["photos with cameras", "found 0", &place],
    );
    refused(&folder, "render @/scene.ply --orbit --fov 180 -o @/out", 3, &["field of view", "180"]);
    refused(&folder, "render @/scene.ply --orbit --size 0x9 -o @/out", 3, &["camera 0", "size"]);
    let line = "render @/scene.ply --cameras @/one.json --size";
    refused(&folder, &format!("{line} 4294967295x4294967295 -o @/out"), 3, &["size of camera 0", "32768"]);
    refused(&folder, &format!("{line} 32768x32768 -o @/out"), 4, &["bytes"]);
}

#[test]
fn weights() {
    let folder = Folder::new();
    let whole = folder.read("micro.safetensors");
    folder.write("cut.safetensors", &whole[..whole.len() - 100]);
    folder.write("empty.safetensors", "");
    let reconstruct = |weights: &str| format!("reconstruct @/photos {weights} --input-size 28x28 -o @/out.ply");
    refused(&folder, &reconstruct("--weights seeded:vitx"), 3, &["vitx", "vits, vitb, vitl, vitg"]);
    refused(&folder, &reconstruct("--weights @/micro.safetensors --variant vitx"), 3, &["vitx"]);
    refused(&folder, &reconstruct("--weights @/micro.safetensors --variant vitb"), 3, &["vitb", "micro"]);
    refused(&folder, &reconstruct("--weights @/cut.safetensors"), 3, &["cut.safetensors"]);
    refused(&folder, &reconstruct("--weights @/empty.safetensors"), 3, &["empty.safetensors"]);
    refused(&folder, &reconstruct("--weights @/absent.safetensors"), 3, &["absent.safetensors", "No such file"]);
    refused(&folder, "convert @/cut.safetensors @/out.safetensors", 3, &["cut.safetensors"]);
    refused(&folder, "convert @/micro.safetensors @/out.safetensors --dtype f64", 3, &["dtype", "f64"]);
    refused(&folder, "convert @/cut.safetensors", 3, &["cut.safetensors"]);
    refused(&folder, "convert @/photos", 3, &["photos"]);
    let photo = format!("reconstruct /dev/zero {MICRO}");
    let weights = reconstruct("--weights /dev/zero");
    for line in [
        "convert /dev/zero",
        "convert /dev/zero @/out.safetensors",
        "render /dev/zero --wiggle -o @/out",
        &photo,
        &weights,
    ] {
        refused(&folder, line, 3, &["/dev/zero: found a device", "a regular file"]);
    }
    refused(&folder, "convert @/photos/1.png", 3, &["1.png: found a picture of 40x30", "safetensors", ".spz"]);
    refused(&folder, "convert @/photos/1.png @/out.safetensors", 3, &["a picture of 40x30", "a checkpoint"]);
    refused(&folder, &reconstruct("--weights @/photos/1.png"), 3, &["a picture of 40x30", "a checkpoint"]);
    folder.write("letter", "a letter, no weights");
    refused(&folder, "convert @/letter", 3, &["letter: found a file of unknown kind", "a checkpoint"]);
    refused(
        &folder,
        "convert @/micro.safetensors --drop-invalid",
        3,
        &["--drop-invalid: found a checkpoint", "a scene"],
    );
}

#[test]
fn scenes_with_hostile_counts() {
    let folder = Folder::new();
    folder.scatter("scene.ply", 5, 0, 0.1);
    let good = folder.read("scene.ply");
    let end = good.windows(11).position(|window| window == b"end_header\n").expect("a header");
    let header = String::from_utf8_lossy(&good[..end]).into_owned();
    for (name, count) in [("a.ply", "4294967295"), ("b.ply", "18446744073709551615"), ("c.ply", "-1"), ("d.ply", "6")] {
        let bytes = [header.replace("vertex 5", &format!("vertex {count}")).as_bytes(), &good[end..]].concat();
        folder.write(name, bytes);
        refused(&folder, &format!("render @/{name} --wiggle -o @/out"), 3, &[name]);
        refused(&folder, &format!("convert @/{name}"), 3, &[name]);
    }
    refused(&folder, "render @/absent.ply --wiggle -o @/out", 3, &["absent.ply"]);
}

#[test]
fn devices() {
    let folder = Folder::new();
    folder.scatter("scene.ply", 5, 0, 0.1);
    let nowhere = "--device nonesuch";
    refused(&folder, &format!("reconstruct @/photos {nowhere} {MICRO}"), 4, &["nonesuch", "0: "]);
    refused(&folder, &format!("render @/scene.ply --wiggle {nowhere} -o @/out"), 4, &["nonesuch"]);
    refused(&folder, &format!("reconstruct --dry-run --views 2 --weights seeded:vits {nowhere}"), 4, &["nonesuch"]);
    refused(&folder, &format!("bench peak {nowhere}"), 4, &["nonesuch"]);
    for line in
        [&format!("reconstruct @/photos {MICRO}"), "doctor list", "render @/scene.ply --wiggle -o @/out", "doctor"]
    {
        refused(
            &folder,
            &format!("--device none {line}"),
            3,
            &["--device: found none", "--dry-run of reconstruct and lift"],
        );
    }
}

#[test]
fn outputs() {
    let folder = Folder::new();
    let reconstruct =
        |output: &str| format!("reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o {output}");
    refused(&folder, &reconstruct("@/absent/out.ply"), 3, &["output folder", "absent"]);
    refused(&folder, &reconstruct("@/photos"), 3, &["output", "the folder"]);
    refused(&folder, &reconstruct("@/out.obj"), 3, &["--output", "out.obj", ".spz"]);
    folder.scatter("scene.ply", 5, 0, 0.1);
    refused(&folder, "render @/scene.ply --wiggle -o @/scene.ply", 3, &["output", "scene.ply"]);
    // Before missing weights or scenes.
    for (line, named) in [
        ("reconstruct @/photos --weights @/absent.safetensors -o /proc/out.ply", "/proc/out.ply: "),
        ("render @/absent.ply --wiggle -o /proc/out", "/proc/out: "),
        ("render @/absent.ply --wiggle -o @/out --video /proc/out.gif", "/proc/out.gif: "),
        ("eval @/absent --views 2 --csv /proc/out.csv", "/proc/out.csv: "),
    ] {
        let outcome = folder.run(line);
        assert!(!outcome.err.contains(".zipsplat-"), "a temporary name: {}", outcome.err);
        outcome.fails(3, &[named]);
    }
}

#[test]
fn earlier_names_of_options() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 3 --size 28x28 --splats -o @/place").success();
    let made = "reconstruct @/place/images --weights @/micro.safetensors -q -o @/";
    for (name, options) in [
        (
            "new.ply",
            "--input-size 28x28 --cameras @/place --scene-scale 2 --token-selection stride --kv-pool 1 \
            --max-gaussians-per-token 2 --crop tiles --world first-camera --precision fp32 --max-memory 3G \
            --refine 2 --init scene --holdout-views=1 --max-gaussians 0 --max-image-size 20x20",
        ),
        (
            "old.ply",
            "--size 28x28 --poses @/place --unit=2 --select stride --pool=1 \
            --keep 2 --fit squares --world first --precision exact --memory 3G \
            --refine=2:gaussians --start scene --hold-out 1 --grow 0 --refine-size 20x20",
        ),
    ] {
        folder.run(&format!("{made}{name} {options}")).success();
    }
    assert_eq!(folder.read("new.ply"), folder.read("old.ply"));
    let steps = "@/place/splats.ply @/place/images --steps 1 -q -o @/refined.ply";
    folder
        .run(&format!("refine {steps} --poses @/place --size 20x20 --batch 2 --invalid drop --invalid=refuse"))
        .success();
    folder.run("render @/place/splats.ply --wiggle --frames 1 --size 8x8 --group 4 --points 1 -o @/out").success();
    folder.run("view @/place/splats.ply --exact --group 4 -o @/page.html").success();
    let micro = "--weights @/micro.safetensors --size 28x28";
    let words = "--pictures @/drawn -- --orbit --frames 1 --size 8x8 --group 4";
    folder
        .run(&format!("reconstruct @/photos {micro} --refine=1:tokens --colmap @/none -o @/a.ply {words}"))
        .fails(3, &["COLMAP"]);
    folder.run(&format!("reconstruct @/photos {micro} -o @/a.ply {words}")).success();
    let eval = format!("eval @/place --views 2 --lpips none {micro}");
    folder.run(&format!("{eval} --score-size 14x14 --whole --disturb 1 --refine 1:tokens --start scene")).success();
    folder.run("eval @/place --views 2 --lpips none --scene @/place/splats.ply --world cameras").success();
    folder.run(&format!("batch @/place {micro} --posed -o @/scenes")).success();
    folder.run("compare @/photos @/photos --lpips none").success();
    folder.run("info").success();
    folder.run("info --max-memory 3G @/new.ply").success();
    let plan = folder.run(&format!("info --plan --views 2 --poses --all --pictures 9x9 --refine 9x9:tokens {micro}"));
    assert!(plan.success().contains("refinement: "));
}
