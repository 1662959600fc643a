//! Depth of photos, with random weights: what is written, and what is refused.

use crate::Folder;
use zipsplat::types::{Image, poses::read_poses, read_points};

/// A network of random numbers, the smallest that is released.
const WEIGHTS: &str = "--weights seeded:da3-small";

#[test]
fn a_folder_gets_depth_cameras_and_points() {
    let folder = Folder::new();
    let line = format!("depth @/photos {WEIGHTS} --size 42 --points 500 -o @/out --json");
    let json = folder.run(&line).json();
    assert_eq!((&json["views"], &json["width"], &json["height"]), (&2.into(), &42.into(), &28.into()));
    let expected = [
        "1.colors.png",
        "1.depth.png",
        "10.colors.png",
        "10.depth.png",
        "depths.safetensors",
        "points.ply",
        "transforms.json",
    ];
    assert_eq!(crate::names(&folder.path("out")), expected);
    assert_eq!(Image::size(folder.path("out/1.depth.png")).unwrap(), (42, 28));
    let bytes = std::fs::read(folder.path("out/depths.safetensors")).unwrap();
    let values = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    for (name, shape) in [
        ("depth", &[2, 28, 42][..]),
        ("confidence", &[2, 28, 42]),
        ("rays", &[2, 16, 24, 6]),
        ("ray_confidence", &[2, 16, 24]),
    ] {
        assert_eq!(values.tensor(name).unwrap().shape(), shape, "{name}");
    }
    let points = read_points(folder.path("out/points.ply")).unwrap().positions.len();
    assert!((100..=500).contains(&points) && json["points"] == points, "{points} points");
    // Of the photos themselves, which other commands read.
    let poses = read_poses(folder.path("out/transforms.json")).unwrap();
    let sizes: Vec<_> = poses.frames.iter().map(|frame| frame.camera.intrinsics.width).collect();
    assert_eq!(sizes, [40, 40]);
    assert!(poses.frames.iter().all(|frame| frame.photo.is_some()), "{poses:?}");
    // The same again, over its own files.
    let read =
        || ["points.ply", "depths.safetensors"].map(|name| std::fs::read(folder.path("out").join(name)).unwrap());
    let first = read();
    folder.run(&line).success();
    assert!(read() == first, "other bits");
}

#[test]
fn wrong_arguments_are_named() {
    let folder = Folder::new();
    let depth = |rest: &str| folder.run(&format!("depth @/photos -o @/out {rest}"));
    depth("--weights seeded:da3-tiny").fails(3, &["da3-tiny", "da3-small"]);
    depth("--weights @/micro.safetensors").fails(3, &["micro.safetensors", "da3-base"]);
    depth("--weights @/none.safetensors").fails(3, &["none.safetensors"]);
    depth(&format!("{WEIGHTS} --reference 3 --size 42")).fails(3, &["--reference", "1 to 2"]);
    depth("").fails_usage();
    assert_eq!(folder.names(), ["micro.safetensors", "photos"]);
}
