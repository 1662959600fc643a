#![cfg(unix)]

use crate::{
    Folder, Outcome,
    cameras::{OPTIONS_3, args, colmap, model, place},
};
use zipsplat::types::{
    Camera, Image, Intrinsics,
    poses::{Capture, CaptureView},
};

/// `$n` in `body` is the attempt; `found` are expected photo counts.
fn tried(body: &str, found: &[usize]) -> (Folder, Outcome) {
    let (folder, frames) = place();
    let options = [
        OPTIONS_3[0],
        OPTIONS_3[1],
        "--random_seed arg --Mapper.min_model_size arg --Mapper.init_min_tri_angle arg --Mapper.init_min_num_inliers arg",
    ];
    colmap(&folder, "colmap", "3.8", options, ["", "", &format!("n=$(grep -c ' mapper ' \"$0.args\"); {body}")]);
    let named = |(i, frame): (usize, &CaptureView)| (format!("0/{i:06}.png"), frame.camera);
    let all: Vec<(String, Camera)> = frames.iter().enumerate().map(named).collect();
    for (n, count) in found.iter().enumerate() {
        let some: Vec<_> = all.iter().take(*count).map(|(name, camera)| (name.as_str(), camera)).collect();
        model(&folder.path(&format!("try{}/0", n + 1)), &some);
    }
    let outcome = folder.run("cameras @/place/images --colmap @/colmap -o @/place/transforms.json --json");
    (folder, outcome)
}

const COPIES: &str = "cp -r \"${0%/*}/try$n/.\" \"$out\" || { echo 'failed to create sparse model'; exit 1; }";

#[test]
fn the_best_of_three_tries_is_kept() {
    let (folder, outcome) = tried(COPIES, &[2, 3, 2]);
    let json = outcome.json();
    assert_eq!((json["registered"].as_u64(), json["attempts"].as_u64()), (Some(3), Some(3)), "{json}");
    let args = args(&folder, "colmap");
    for words in [
        "random_seed 0 --Mapper.init_min_tri_angle 16 --Mapper.init_min_num_inliers 100",
        "random_seed 1 --Mapper.init_min_tri_angle 8 --Mapper.init_min_num_inliers 50",
        "random_seed 2 --Mapper.init_min_tri_angle 4 --Mapper.init_min_num_inliers 30",
    ] {
        assert!(args.contains(words), "'{words}' is not in {args}");
    }
    assert_eq!(args.matches("feature_extractor").count(), 1, "{args}");
}

#[test]
fn tries_end_where_all_are_found() {
    for (found, tries) in [(&[4][..], 1), (&[2, 4], 2), (&[0, 0, 4], 3)] {
        let (_, outcome) = tried(COPIES, found);
        let json = outcome.json();
        assert_eq!((json["registered"].as_u64(), json["attempts"].as_u64()), (Some(4), Some(tries)), "{json}");
    }
}

#[test]
fn lost_photos_do_not_take_the_cameras_of_others_of_their_name() {
    let (folder, frames) = place();
    let photos = ["left/000.png", "left/001.png", "right/000.png", "right/001.png"];
    for (i, photo) in photos.into_iter().enumerate() {
        folder.write(photo, folder.read(&format!("place/images/{i:03}.png")));
    }
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", crate::cameras::COPIES]);
    let names: Vec<String> = (0..3).map(|i| format!("0/{i:06}.png")).collect();
    let named: Vec<_> = names.iter().map(String::as_str).zip(frames.iter().map(|frame| &frame.camera)).collect();
    model(&folder.path("colmap.model/0"), &named);
    let find = "@/left @/right --cameras colmap --colmap @/colmap --json";
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    for line in [
        format!("reconstruct {find} {micro} --refine=1 -o @/scene.ply"),
        format!("refine {find} --init points --steps 1 -o @/scene.ply"),
        format!("view {find} {micro} --ratios 1 -o @/page.html"),
    ] {
        let outcome = folder.run(&line);
        assert!(outcome.err.contains("without a camera: 001.png"), "{}", outcome.err);
        let json = outcome.json();
        assert!(line.starts_with("view") || json["photos"] == 3, "{json}");
    }
}

/// COLMAP's text separates fields by spaces.
#[test]
fn names_that_a_colmap_model_cannot_hold_are_refused_first() {
    let (folder, _) = place();
    colmap(&folder, "unused", "3.8", OPTIONS_3, [""; 3]);
    folder.write("place/images/left one/9.png", folder.read("place/images/000.png"));
    let line = "cameras @/place/images --recursive --colmap @/unused -o @/c.json --colmap-model @/model";
    folder.run(line).fails(3, &["name of a photo for COLMAP", "left one/9.png"]);
    assert!(!folder.path("unused.args").exists() && !folder.path("model").exists());
}

#[test]
fn four_fifths_of_many_photos_are_enough() {
    let (folder, frames) = place();
    let one = folder.read("place/images/000.png");
    for i in 4..14 {
        folder.write(&format!("place/images/{i:03}.png"), &one);
    }
    colmap(&folder, "half", "3.8", OPTIONS_3, ["", "", crate::cameras::COPIES]);
    let names: Vec<String> = (0..11).map(|i| format!("0/{i:06}.png")).collect();
    for (count, tries) in [(11, 1), (10, 3)] {
        let some: Vec<_> = names.iter().take(count).map(|name| (name.as_str(), &frames[0].camera)).collect();
        model(&folder.path("half.model/0"), &some);
        let line = "cameras @/place/images --colmap @/half -o @/place/transforms.json --json";
        assert_eq!(folder.run(line).json()["attempts"], tries);
    }
}

#[test]
fn an_unlikely_lens_is_mapped_again_with_a_fixed_one() {
    let (folder, frames) = place();
    let options =
        [OPTIONS_3[0], OPTIONS_3[1], "--Mapper.ba_refine_focal_length arg --Mapper.ba_refine_extra_params arg"];
    let body = format!("n=$(grep -c ' mapper ' \"$0.args\"); {COPIES}");
    let of = |(i, frame): (usize, &CaptureView), ratio: f64| {
        let lens = frame.camera.intrinsics;
        let fx = ratio * f64::from(lens.width.max(lens.height));
        (format!("0/{i:06}.png"), Camera { intrinsics: Intrinsics { fx, fy: fx, ..lens }, ..frame.camera })
    };
    let more = "5 0 0 4 10 20 30 0.1\n";
    for (counts, with_more, kept) in
        [([4, 4, 4], 1, 1.2), ([4, 4, 4], 2, 1.3), ([3, 3, 4], 0, 1.3), ([4, 3, 3], 2, 0.2)]
    {
        colmap(&folder, "colmap", "3.8", options, ["", "", &body]);
        for (attempt, (count, ratio)) in counts.into_iter().zip([0.2, 1.2, 1.3]).enumerate() {
            let found: Vec<_> = frames.iter().enumerate().take(count).map(|frame| of(frame, ratio)).collect();
            let named: Vec<_> = found.iter().map(|(name, camera)| (name.as_str(), camera)).collect();
            let name = format!("try{}/0", attempt + 1);
            model(&folder.path(&name), &named);
            if attempt == with_more {
                let points = format!("{name}/points3D.txt");
                folder.write(&points, format!("{}{more}", folder.text(&points)).as_bytes());
            }
        }
        let line = "cameras @/place/images --colmap @/colmap -o @/found.json --overwrite";
        let text = folder.run(line).success();
        assert!(text.contains("4 of 4 photos") && text.contains("the best of 3 attempts"), "{text}");
        assert_eq!(text.contains("is unlikely"), kept < 1.0, "{text}");
        let lens = Capture::open(folder.path("found.json")).expect("cameras").frames[0].camera.intrinsics;
        // Undistortion moves it a little.
        assert!((lens.fx / f64::from(lens.width) - kept).abs() < 0.02, "{counts:?}: {lens:?}");
        let args = args(&folder, "colmap");
        let mapped: Vec<&str> = args.lines().filter(|line| line.contains(" mapper ")).collect();
        assert!(mapped.len() == 3 && mapped[0].contains("focal_length 1 --Mapper.ba_refine_extra_params 1"), "{args}");
        let fixed = |line: &&str| line.contains("focal_length 0 --Mapper.ba_refine_extra_params 0");
        assert!(mapped[1..].iter().all(fixed), "{args}");
        folder.remove("colmap.args");
    }
}

#[test]
fn cameras_are_kept_where_a_later_try_fails() {
    let killed = format!("[ $n = 2 ] && kill -9 $$; {COPIES}");
    let (_, outcome) = tried(&killed, &[3]);
    let json = outcome.json();
    assert_eq!((json["registered"].as_u64(), json["attempts"].as_u64()), (Some(3), Some(2)), "{json}");
}

#[test]
fn a_group_that_cannot_be_read_is_left_out() {
    let group = "cp -r \"${0%/*}/try1/.\" \"$out\"; mkdir \"$out/1\"; echo damaged > \"$out/1/images.txt\"; echo damaged > \"$out/1/cameras.txt\"";
    let (_, outcome) = tried(group, &[4]);
    let json = outcome.json();
    assert_eq!(json["registered"].as_u64(), Some(4), "{json}");
    let (_, outcome) = tried(&group.replace("cp -r", ": "), &[4]);
    assert!(outcome.code == 3 && outcome.err.contains("sparse0/1/"), "{}", outcome.err);
}

#[test]
fn a_focal_length_that_no_photo_has_is_told() {
    let (folder, frames) = place();
    let options = [OPTIONS_3[0], OPTIONS_3[1], "--Mapper.min_model_size arg"];
    for (ratio, unlikely) in [(0.3, true), (0.4, false), (4.0, false), (6.0, true)] {
        colmap(&folder, "colmap", "3.8", options, ["", "", "cp -r \"${0%/*}/found/.\" \"$out\""]);
        let of = |frame: &CaptureView| {
            let fx = ratio * f64::from(frame.camera.intrinsics.width.max(frame.camera.intrinsics.height));
            Camera { intrinsics: Intrinsics { fx, fy: fx, ..frame.camera.intrinsics }, ..frame.camera }
        };
        let cameras: Vec<(String, Camera)> =
            frames.iter().enumerate().map(|(i, frame)| (format!("0/{i:06}.png"), of(frame))).collect();
        let named: Vec<_> = cameras.iter().map(|(name, camera)| (name.as_str(), camera)).collect();
        model(&folder.path("found/0"), &named);
        let text = folder.run("cameras @/place/images --colmap @/colmap -o @/found.json --overwrite").success();
        assert_eq!(text.contains("is unlikely"), unlikely, "{ratio}: {text}");
    }
}

#[test]
fn masks_are_given_by_colmaps_names() {
    let (folder, _) = place();
    let features = "for image in $(cd \"$images\" && find . ! -type d); do echo \"$image\"; cmp \"$images/../masks/$image.png\" \"${0%/*}/mask.png\" && echo same; done >\"$0.masks\"";
    colmap(&folder, "colmap", "3.8", OPTIONS_3, [features, "", "exit 1"]);
    folder.make("masks");
    for i in 0..4 {
        let mask = image::GrayImage::from_fn(42, 28, |x, y| image::Luma([u8::from(x > y) * 9]));
        mask.save(folder.path(&format!("masks/{i:03}.png"))).expect("a mask");
    }
    let expected: Vec<u8> = (0..28 * 42).flat_map(|at| [if at % 42 > at / 42 { 255 } else { 0 }; 3]).collect();
    Image::new(42, 28, expected).expect("a mask").save_png(folder.path("mask.png")).expect("a mask");
    folder.run("cameras @/place/images --masks @/masks --colmap @/colmap -o @/cameras.json");
    let args = args(&folder, "colmap");
    assert!(args.lines().next().is_some_and(|line| line.contains("--ImageReader.mask_path")), "{args}");
    assert_eq!(folder.text("colmap.masks").matches("same").count(), 4, "{}", folder.text("colmap.masks"));
}

#[test]
fn cameras_of_long_videos_follow_from_keyframes() {
    let folder = Folder::new();
    folder.make("frames");
    let names: Vec<String> = (0..201).map(|i| format!("0/{i:06}.png")).collect();
    for i in 0..names.len() {
        crate::photo(40, 30, 1).save_png(folder.path(&format!("frames/{i:03}.png"))).expect("a photo");
    }
    let mapper = format!("cp \"${{out%/*}}/keyframes.txt\" \"$0.keys\"; {}", crate::cameras::COPIES);
    let camera = zipsplat_tests::scenes::camera(40, 30);
    let frames: Vec<_> = names.iter().map(|name| (name.as_str(), &camera)).collect();
    let matcher = "[ -f \"$0.pairs\" ] || cp \"$pairs\" \"$0.pairs\"; cp \"$pairs\" \"$0.last\"";
    let run = |count: usize, mapper: &str| {
        colmap(&folder, "video", "3.8", OPTIONS_3, ["", matcher, mapper]);
        model(&folder.path("video.model/0"), &frames[..count]);
        let json = folder.run("cameras @/frames --colmap @/video -o @/video.json --overwrite --json").json();
        assert_eq!(json["registered"], count);
        let args = args(&folder, "video");
        folder.remove("video.args");
        ["_matcher ", " matches_importer ", " mapper ", " image_registrator "]
            .map(|verb| args.lines().filter(|line| line.contains(verb)).map(str::to_owned).collect::<Vec<_>>())
    };
    let [all, chosen, mappers, others] = run(201, &mapper);
    let keys = folder.text("video.keys");
    assert!(keys.lines().eq(names.iter().step_by(2)), "{keys}");
    assert_eq!((all.len(), chosen.len()), (0, 1));
    let pairs = folder.text("video.pairs");
    let partners = |i: usize| {
        let of = |pair: &str| pair.strip_prefix(&names[i])?.trim_start().to_owned().into();
        pairs.lines().filter_map(of).collect::<Vec<String>>()
    };
    let expected = |places: &[usize]| places.iter().map(|i| names[*i].clone()).collect::<Vec<_>>();
    assert_eq!(partners(7), expected(&[6, 8]));
    assert_eq!(partners(196), expected(&[198, 200]));
    assert_eq!(partners(0), expected(&[2, 4, 6, 8, 10, 12, 14, 16, 18, 32, 64, 128]));
    assert!(mappers.len() == 1 && mappers[0].contains("keyframes.txt"), "{mappers:?}");
    let [_, paths] = others[0].split(" --input_path ").collect::<Vec<_>>()[..] else { panic!("{others:?}") };
    let (from, to) = paths.split_once(" --output_path ").expect("an output");
    assert!(others.len() == 1 && from == to && from.ends_with("sparse0/0"), "{others:?}");
    // All neighbors are matched and all photos mapped if few are registered.
    for mapper in [mapper.clone(), format!("{mapper};; image_registrator) exit 1")] {
        let [all, chosen, mappers, others] = run(150, &mapper);
        assert_eq!((all.len(), chosen.len()), (0, 2));
        let distances = (1..10).chain([16, 32, 64, 128]);
        assert_eq!(folder.text("video.last").lines().count(), distances.map(|far: usize| 201 - far).sum::<usize>());
        assert!(mappers.iter().map(|line| line.contains("keyframes")).eq([true, false, false]), "{mappers:?}");
        assert_eq!(others.len(), 1);
    }
}

#[test]
fn photos_of_alternating_lenses_are_matched_in_their_order() {
    let folder = Folder::new();
    let lenses = [40, 50].map(|width| zipsplat_tests::scenes::camera(width, 30));
    let frames: Vec<_> = (0..12).map(|i: usize| (format!("{}/{i:06}.png", i % 2), &lenses[i % 2])).collect();
    let frames: Vec<_> = frames.iter().map(|(name, camera)| (name.as_str(), *camera)).collect();
    let mut expected = Vec::new();
    folder.make("frames");
    for (i, (name, camera)) in frames.iter().enumerate() {
        let path = folder.path(&format!("frames/{i:03}.png"));
        crate::photo(camera.intrinsics.width, 30, 1).save_png(path).expect("a photo");
        expected.extend(frames.iter().skip(i + 1).take(9).map(|(next, _)| format!("{name} {next}")));
    }
    let copies = crate::cameras::COPIES;
    colmap(&folder, "native", "3.8", OPTIONS_3, ["", "cp \"$pairs\" \"$0.pairs\"", copies]);
    let python = format!(
        "#!/bin/sh
[ $# = 2 ] && {{ echo 3.11.1; exit 0; }}
out=$5
case $3 in
pairs) cp \"$4/pairs.txt\" \"$0.pairs\";;
cameras) {copies};;
esac
"
    );
    folder.script("python", &python);
    for (option, name) in [("--colmap", "native"), ("--python", "python")] {
        model(&folder.path(&format!("{name}.model/0")), &frames);
        let line = "cameras @/frames --matching sequential -o @/found.json --overwrite --json";
        assert_eq!(folder.run(&format!("{line} {option} @/{name}")).json()["registered"], 12);
        assert_eq!(folder.text(&format!("{name}.pairs")), expected.join("\n"), "{name}");
    }
}

#[test]
fn truncated_photos_are_refused_before_matching() {
    let (folder, _) = place();
    colmap(&folder, "unused", "3.8", OPTIONS_3, ["", "", ""]);
    let jpeg = crate::photo(42, 28, 1).jpeg(90).expect("a JPEG");
    folder.write("place/images/004.jpg", &jpeg[..jpeg.len() - 2]);
    let outcome = folder.run("cameras @/place/images --colmap @/unused -o @/cameras.json");
    outcome.fails(3, &["004.jpg", "found a JPEG without its end marker", "expected a whole file"]);
    assert!(!folder.path("unused.args").exists());
}
