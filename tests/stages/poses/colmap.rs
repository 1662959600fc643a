use super::{LENS, assert_format_error, assert_same_cameras, cameras, of, put_photos};
use zipsplat::types::poses::{CaptureView, read_cloud, write_colmap, write_transforms};
use zipsplat::types::{Distortion, Lens, quaternion_from_matrix};
use zipsplat_tests::prelude::*;

/// World-to-camera `[qw, qx, qy, qz, tx, ty, tz]`.
fn colmap_pose(pose: &Pose) -> [f64; 7] {
    let view = pose.inverse();
    let ([w, x, y, z], t) = (quaternion_from_matrix(&view.rotation), view.translation);
    [w, x, y, z, t.x, t.y, t.z]
}

fn text_model(folder: &Path, lens: &str, cameras: &[Camera], names: &[String]) {
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("cameras.txt"), format!("# Camera list\n#\n4 {lens}\n")).unwrap();
    let mut images = String::from("# Image list with two lines of data per image:\n");
    for (i, (camera, name)) in cameras.iter().zip(names).enumerate().rev() {
        let numbers: Vec<String> = colmap_pose(&camera.pose).map(|value| format!("{value:?}")).into();
        // Images without points have an empty second line.
        let points = if i % 2 == 0 { "" } else { "12.5 7.25 -1 3.0 4.0 17" };
        images += &format!("{} {} 4 {name}\n{points}\n", i + 1, numbers.join(" "));
    }
    fs::write(folder.join("images.txt"), images).unwrap();
}

fn binary_model(folder: &Path, model: i32, params: &[f64], cameras: &[Camera], names: &[String]) {
    fs::create_dir_all(folder).unwrap();
    let mut bytes = 1u64.to_le_bytes().to_vec();
    bytes.extend(4u32.to_le_bytes());
    bytes.extend(model.to_le_bytes());
    bytes.extend(u64::from(LENS.width).to_le_bytes());
    bytes.extend(u64::from(LENS.height).to_le_bytes());
    params.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    fs::write(folder.join("cameras.bin"), bytes).unwrap();
    let mut bytes = (cameras.len() as u64).to_le_bytes().to_vec();
    for (i, (camera, name)) in cameras.iter().zip(names).enumerate().rev() {
        bytes.extend((i as u32 + 1).to_le_bytes());
        colmap_pose(&camera.pose).iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes.extend(4u32.to_le_bytes());
        bytes.extend(name.as_bytes());
        bytes.push(0);
        bytes.extend((i as u64).to_le_bytes());
        bytes.extend(vec![0xaa; 24 * i]);
    }
    fs::write(folder.join("images.bin"), bytes).unwrap();
}

const PINHOLE: [f64; 4] = [LENS.fx, LENS.fy, LENS.cx, LENS.cy];

#[test]
fn colmap_models_agree_with_transforms() {
    let (truth, names) = cameras();
    let names: Vec<String> = names.iter().map(|name| name.replace("images/", "")).collect();
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("text");
    text_model(&text, "PINHOLE 64 48 70.0 71.5 31.25 24.5", &truth, &names);
    let capture = folder.path().join("capture");
    binary_model(&capture.join("sparse/0"), 1, &PINHOLE, &truth, &names);
    put_photos(&capture, &["images/003.png".into()]);
    let nerfstudio = capture.join("colmap/sparse/0");
    binary_model(&nerfstudio, 1, &PINHOLE, &truth, &names);
    for path in [
        text.clone(),
        text.join("images.txt"),
        capture.clone(),
        capture.join("sparse/0"),
        capture.join("sparse"),
        nerfstudio,
    ] {
        let Ok(poses) = Capture::open(&path) else { panic!("{}", path.display()) };
        assert_same_cameras(&of(&poses), &truth);
        assert_eq!((poses.frames[3].name.as_str(), &poses.warnings), ("003.png", &vec![]));
        assert_eq!(poses.frames[3].photo.is_some(), path.starts_with(&capture));
    }
    let empty = folder.path().join("capture/images");
    assert!(matches!(Capture::open(&empty), Err(Error::Argument { .. })));
}

#[test]
fn colmap_lenses_are_read_and_distortion_is_undone() {
    let (truth, names) = cameras();
    let single = Intrinsics { fy: LENS.fx, ..LENS };
    let cases = [
        (0, "SIMPLE_PINHOLE", vec![70.0, 31.25, 24.5], single, false),
        (1, "PINHOLE", PINHOLE.to_vec(), LENS, false),
        (2, "SIMPLE_RADIAL", vec![70.0, 31.25, 24.5, 0.1], single, true),
        (3, "RADIAL", vec![70.0, 31.25, 24.5, 0.0, -0.1], single, true),
        (4, "OPENCV", [&PINHOLE[..], &[0.0; 4]].concat(), LENS, false),
        (6, "FULL_OPENCV", [&PINHOLE[..], &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3]].concat(), LENS, true),
    ];
    for (model, name, params, lens, distorted) in cases {
        let folder = tempfile::tempdir().unwrap();
        let (text, binary) = (folder.path().join("text"), folder.path().join("binary"));
        let numbers: Vec<String> = params.iter().map(f64::to_string).collect();
        text_model(&text, &format!("{name} 64 48 {}", numbers.join(" ")), &truth, &names);
        binary_model(&binary, model, &params, &truth, &names);
        for path in [text, binary] {
            let poses = Capture::open(&path).unwrap();
            for frame in &poses.frames {
                assert_eq!(frame.lens.is_some(), distorted, "{name}");
                let taken = frame.lens.map_or(frame.camera.intrinsics, |lens| lens.intrinsics);
                assert_eq!(taken, lens, "{name}");
            }
            assert!(poses.warnings.is_empty(), "{name}: {:?}", poses.warnings);
        }
    }
}

#[test]
fn malformed_colmap_models_are_refused() {
    let (truth, names) = cameras();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let spoil = |file: &str, from: &str, to: &str| {
        text_model(path, "PINHOLE 64 48 70.0 71.5 31.25 24.5", &truth, &names);
        let text = fs::read_to_string(path.join(file)).unwrap();
        assert!(text.contains(from));
        fs::write(path.join(file), text.replacen(from, to, 1)).unwrap();
    };
    for (file, from, to, reason) in [
        ("cameras.txt", "PINHOLE", "THIN_PRISM_FISHEYE", "undistort"),
        ("cameras.txt", "24.5", "", "line 3: PARAMS[3]"),
        ("cameras.txt", "64", "-64", "WIDTH"),
        ("cameras.txt", "70.0", "NaN", "fx"),
        ("cameras.txt", "\n4 ", "\n5 ", "has camera 4"),
        ("images.txt", "\n7 ", "\n7 x", "line 2: QW"),
        ("images.txt", " 4 images/006.png", "", "line 2: CAMERA_ID"),
    ] {
        spoil(file, from, to);
        assert_format_error(path, &[file.trim_start_matches("cameras"), reason]);
    }

    let binary = |file: &str, change: &dyn Fn(&mut Vec<u8>)| {
        binary_model(path, 1, &PINHOLE, &truth, &names);
        let mut bytes = fs::read(path.join(file)).unwrap();
        change(&mut bytes);
        fs::write(path.join(file), bytes).unwrap();
    };
    for count in [8, u64::MAX / 24, u64::MAX] {
        binary("images.bin", &|bytes| bytes[..8].copy_from_slice(&count.to_le_bytes()));
        assert_format_error(path, &["images.bin", "truncated"]);
        // Image 006 is first and has 6 points.
        let points = 8 + 4 + 7 * 8 + 4 + "images/006.png".len() + 1;
        binary("images.bin", &|bytes| bytes[points..points + 8].copy_from_slice(&count.to_le_bytes()));
        assert_format_error(path, &["images.bin"]);
        binary("cameras.bin", &|bytes| bytes[..8].copy_from_slice(&count.to_le_bytes()));
        assert_format_error(path, &["cameras.bin", "truncated"]);
    }
    binary("images.bin", &|bytes| bytes[12..44].fill(0));
    assert_format_error(path, &["006.png", "rotation"]);
    binary("cameras.bin", &|bytes| bytes[12..16].copy_from_slice(&7i32.to_le_bytes()));
    assert_format_error(path, &["camera model 7"]);
    let len = fs::read(path.join("images.bin")).unwrap().len();
    for kept in (0..len).step_by(11) {
        binary("images.bin", &|bytes| bytes.truncate(kept));
        assert_format_error(path, &["images.bin", "truncated"]);
    }
    fs::remove_file(path.join("images.bin")).unwrap();
    assert!(matches!(Capture::open(path), Err(Error::Io { path, .. }) if path.ends_with("images.bin")));
}

#[test]
fn point_clouds_are_found_and_read() {
    let (truth, names) = cameras();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let points = [[1.5, -2.0, 3.25], [0.0, 4.0, 8.0]];
    text_model(&path("text"), "PINHOLE 64 48 70.0 71.5 31.25 24.5", &truth, &names);
    assert_eq!(Capture::open(path("text")).unwrap().points, None);
    let lines = "# 3D point list\n7 1.5 -2.0 3.25 1 2 3 0.5 1 2 2 9\n9 0 4 8 1 2 3 0.25\n";
    fs::write(path("text/points3D.txt"), lines).unwrap();

    binary_model(&path("binary"), 1, &PINHOLE, &truth, &names);
    let mut bytes = 2u64.to_le_bytes().to_vec();
    for (i, point) in points.iter().enumerate() {
        bytes.extend((i as u64).to_le_bytes());
        point.iter().for_each(|value: &f64| bytes.extend(value.to_le_bytes()));
        bytes.extend([1, 2, 3]);
        bytes.extend(0.5f64.to_le_bytes());
        bytes.extend((i as u64).to_le_bytes());
        bytes.extend(vec![2; 8 * i]);
    }
    fs::write(path("binary/points3D.bin"), &bytes).unwrap();

    fs::create_dir(path("json")).unwrap();
    write_transforms(path("json/transforms.json"), &truth, &names).unwrap();
    assert_eq!(Capture::open(path("json")).unwrap().points, None);
    let narrow = points.map(|point| point.map(|value| value as f32));
    zipsplat::types::write_points(path("json/points.ply"), &narrow.map(|point| (point, [1, 2, 3]))).unwrap();

    for (model, file) in [("text", "points3D.txt"), ("binary", "points3D.bin"), ("json", "points.ply")] {
        let found = Capture::open(path(model)).unwrap().points;
        assert_eq!(found, Some(path(model).join(file)));
        let cloud = read_cloud(found.unwrap()).unwrap();
        assert_eq!((cloud.positions, cloud.colors), (narrow.to_vec(), vec![[1, 2, 3]; narrow.len()]), "{file}");
    }
    fs::copy(path("json/points.ply"), path("points3D.ply")).unwrap();
    assert_eq!(read_cloud(path("points3D.ply")).unwrap().positions, narrow);
    for (kind, colors) in [("uchar", vec![[1, 0, 1]]), ("float", Vec::new())] {
        let columns = ["float"; 3].into_iter().chain([kind; 3]).zip(["x", "y", "z", "red", "green", "blue"]);
        let properties: String = columns.map(|(kind, name)| format!("property {kind} {name}\n")).collect();
        let text = format!("ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n1 2 3 1 0 1\n");
        fs::write(path("colors.ply"), text).unwrap();
        assert_eq!(read_cloud(path("colors.ply")).unwrap().colors, colors, "{kind}");
    }
    for (file, bytes, reason) in [
        ("binary/points3D.bin", bytes[..bytes.len() - 1].to_vec(), "truncated"),
        ("text/points3D.txt", b"7 1.5 here 3.25\n".to_vec(), "line 1: Y"),
        ("text/points3D.txt", b"7 1.5 NaN 3.25 1 2 3 0.5\n".to_vec(), "finite"),
        (
            "json/points.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n".to_vec(),
            "y",
        ),
    ] {
        fs::write(path(file), bytes).unwrap();
        assert_refused(read_cloud(path(file)), &[reason, "points"]);
    }
}

#[test]
fn models_are_written_as_they_are_read() {
    let (truth, names) = cameras();
    let folder = tempfile::tempdir().unwrap();
    let of_lens = |distortion: Distortion| Lens { intrinsics: LENS, distortion, view: 0 };
    let bent = |k3: f64| Distortion::Perspective {
        numerator: [-0.05, 0.01, k3, 0.0],
        denominator: [k3, 0.0, 0.5 * k3],
        tangential: [1e-3, -2e-3],
    };
    let lenses = [
        None,
        None,
        Some(of_lens(bent(0.0))),
        Some(of_lens(bent(0.002))),
        Some(of_lens(Distortion::Fisheye([0.01, 0.0, 0.02, 0.0]))),
    ];
    let frame = |((camera, name), lens): ((&Camera, &String), &Option<Lens>)| {
        let intrinsics = lens.map_or(camera.intrinsics, |lens| lens.pinhole("lens").unwrap());
        CaptureView {
            name: name.replace("images/", ""),
            photo: None,
            camera: Camera { intrinsics, ..*camera },
            lens: *lens,
        }
    };
    let mut frames: Vec<CaptureView> = truth.iter().zip(&names).zip(lenses.iter().cycle()).map(frame).collect();
    let points = [([1.5, -2.0, 0.1], [1, 2, 3]), ([0.0, 4.0, 8.0], [255, 0, 7])];
    write_colmap(folder.path(), &frames, &points).unwrap();
    let read = Capture::open(folder.path()).unwrap();
    assert_eq!(read.frames.len(), frames.len());
    for (read, frame) in read.frames.iter().zip(&frames) {
        assert_eq!((&read.name, read.lens, read.camera.intrinsics), (&frame.name, frame.lens, frame.camera.intrinsics));
    }
    assert_same_cameras(&of(&read), &frames.iter().map(|frame| frame.camera).collect::<Vec<_>>());
    let cloud = read_cloud(read.points.unwrap()).unwrap();
    assert_eq!(cloud.positions.into_iter().zip(cloud.colors).collect::<Vec<_>>(), points);
    let lines = fs::read_to_string(folder.path().join("cameras.txt")).unwrap();
    assert_eq!(lines.lines().filter(|line| !line.starts_with('#')).count(), frames.len().min(4), "{lines}");

    frames[1].name = "two words.png".into();
    assert_refused(write_colmap(folder.path(), &frames, &[]), &["two words.png"]);
    let ninth =
        Distortion::Perspective { numerator: [0.0, 0.0, 0.0, 1e-3], denominator: [0.0; 3], tangential: [0.0; 2] };
    frames.truncate(1);
    frames[0].lens = Some(of_lens(ninth));
    assert_refused(write_colmap(folder.path(), &frames, &[]), &["r^8"]);
}
