mod colmap;
mod lens;
mod realestate;
mod wide;

use glam::DMat4;
use serde_json::{Value, json};
use zipsplat::{types::Orbit, types::poses::write_transforms};
use zipsplat_tests::prelude::*;

const LENS: Intrinsics = Intrinsics { width: 64, height: 48, fx: 70.0, fy: 71.5, cx: 31.25, cy: 24.5 };

fn cameras() -> (Vec<Camera>, Vec<String>) {
    let orbit = Orbit { center: DVec3::new(0.5, -1.0, 7.0), radius: 3.0 };
    let tilt = orbit.pose(20.0, 40.0);
    let poses = orbit.sweep(7, 13.0, 300.0, -25.0).into_iter().map(|pose| tilt.compose(&pose));
    let cameras = poses.map(|pose| Camera { intrinsics: LENS, pose }).collect();
    (cameras, (0..7).map(|i| format!("images/{i:03}.png")).collect())
}

#[track_caller]
fn assert_same_cameras(found: &[Camera], truth: &[Camera]) {
    assert_eq!(found.len(), truth.len());
    for (i, (found, truth)) in found.iter().zip(truth).enumerate() {
        assert_eq!(found.intrinsics, truth.intrinsics, "camera {i}");
        assert_same_pose(&found.pose, &truth.pose, i);
    }
}

#[track_caller]
fn assert_same_pose(found: &Pose, truth: &Pose, i: usize) {
    assert!(found.matrix().abs_diff_eq(truth.matrix(), 1e-12), "camera {i}: {found:?}, truth {truth:?}");
}

fn of(poses: &Capture) -> Vec<Camera> {
    poses.frames.iter().map(|frame| frame.camera).collect()
}

#[track_caller]
fn assert_format_error(path: &Path, parts: &[&str]) {
    let error = assert_refused(Capture::open(path), parts);
    assert!(matches!(error, Error::Format { .. }), "{error}");
}

fn capture(change: impl FnOnce(&mut Value)) -> (tempfile::TempDir, PathBuf) {
    let (cameras, names) = cameras();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &cameras, &names).unwrap();
    let mut json: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut json);
    fs::write(&path, serde_json::to_vec(&json).unwrap()).unwrap();
    (folder, path)
}

fn put_photos(folder: &Path, names: &[String]) {
    fs::create_dir_all(folder.join("images")).unwrap();
    for name in names {
        let photo = Image::new(LENS.width, LENS.height, vec![9; (3 * LENS.width * LENS.height) as usize]).unwrap();
        photo.save_png(folder.join(name)).unwrap();
    }
}

#[test]
fn transforms_survive_a_file() {
    let (mut cameras, names) = cameras();
    let (folder, path) = capture(|_| ());
    assert_same_cameras(&of(&Capture::open(&path).unwrap()), &cameras);
    assert_same_cameras(&of(&Capture::open(folder.path()).unwrap()), &cameras);
    // y up, z backward.
    let json: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let up = json["frames"][0]["transform_matrix"][1][1].as_f64().unwrap();
    assert_eq!(up, -cameras[0].pose.rotation.y_axis.y);
    assert_eq!(json["fl_x"], json!(LENS.fx), "shared intrinsics stand at the top");

    cameras[3].intrinsics.fx = 99.0;
    write_transforms(&path, &cameras, &names).unwrap();
    assert_same_cameras(&of(&Capture::open(&path).unwrap()), &cameras);
    assert!(matches!(write_transforms(&path, &cameras, &names[1..]), Err(Error::Argument { .. })));
    cameras[2].pose.translation.x = f64::NAN;
    assert_refused(write_transforms(&path, &cameras, &names), &["camera 2, translation"]);
}

#[test]
fn intrinsics_come_from_angles_frames_and_photos() {
    let (truth, names) = cameras();
    let angle = 2.0 * (f64::from(LENS.width) / (2.0 * LENS.fx)).atan();
    let centered = Intrinsics { fy: LENS.fx, cx: 32.0, cy: 24.0, ..LENS };
    // NeRF's synthetic scenes.
    let (folder, path) = capture(|json| {
        let frames = json["frames"].as_array().unwrap().clone();
        *json = json!({"camera_angle_x": angle, "frames": frames});
        for frame in json["frames"].as_array_mut().unwrap() {
            frame["file_path"] = json!(format!("./{}", frame["file_path"].as_str().unwrap().trim_end_matches(".png")));
        }
    });
    let none = Capture::open(&path).unwrap();
    assert!(none.frames.is_empty() && none.warnings[0].contains("7 frames left out"), "{:?}", none.warnings);
    put_photos(folder.path(), &names[..5]);
    let poses = Capture::open(&path).unwrap();
    assert!(poses.frames.len() == 5 && poses.warnings[0].contains("2 frames left out"), "{:?}", poses.warnings);
    for (frame, name) in poses.frames.iter().zip(&names) {
        assert!((frame.camera.intrinsics.fx - LENS.fx).abs() < 1e-9);
        let found = Intrinsics { fx: LENS.fx, fy: LENS.fx, ..frame.camera.intrinsics };
        assert_eq!(found, centered);
        assert_eq!(frame.photo.as_deref().and_then(Path::file_name), Path::new(name).file_name());
    }
    let photos: Vec<PathBuf> = names[..5].iter().rev().map(|name| folder.path().join(name)).collect();
    let matched = poses.for_photos(&photos).unwrap();
    for (i, (found, truth)) in matched.iter().zip(truth[..5].iter().rev()).enumerate() {
        assert_same_pose(&found.pose, &truth.pose, i);
    }

    let (_folder, path) = capture(|json| {
        json["frames"][2]["fl_x"] = json!(80.0);
        json["frames"][2]["w"] = json!(65.0);
        json["frames"][4]["k1"] = json!(0.1);
        json["frames"][3]["view"] = json!("front");
        json["frames"][4]["view"] = json!(7);
    });
    let poses = Capture::open(&path).unwrap();
    assert_eq!(poses.frames[2].camera.intrinsics, Intrinsics { fx: 80.0, width: 65, ..LENS });
    assert_eq!(poses.frames[3].camera.intrinsics, LENS);
    assert!(poses.frames[4].lens.is_some() && poses.warnings.is_empty(), "{:?}", poses.warnings);
}

#[test]
fn malformed_transforms_name_the_file_the_frame_and_the_field() {
    type Spoil = fn(&mut Value);
    let spoils: [(&[&str], Spoil); 15] = [
        (&["frames"], |json| json["frames"] = json!(3)),
        (&["frames[1]", "file_path"], |json| json["frames"][1]["file_path"] = json!(7)),
        (&["frames[1]", "transform_matrix"], |json| json["frames"][1]["transform_matrix"] = json!("eye")),
        (&["frames[6]", "transform_matrix"], |json| json["frames"][6]["transform_matrix"][0] = json!([1, 2, 3])),
        (&["frames[6]", "transform_matrix"], |json| json["frames"][6]["transform_matrix"][2][1] = json!(null)),
        (&["frames[6]", "transform_matrix"], |json| json["frames"][6]["transform_matrix"][3][0] = json!(0.5)),
        (&["frames[2]", "rotation"], |json| json["frames"][2]["transform_matrix"][0][0] = json!(3.0)),
        (&["frames[0]", "fl_x", "wide"], |json| json["fl_x"] = json!("wide")),
        (&["frames[3]", "fx", "-5"], |json| json["frames"][3]["fl_x"] = json!(-5)),
        (&["frames[0]", "w"], |json| json["w"] = json!(64.5)),
        (&["frames[0]", "h"], |json| json["h"] = json!(-1)),
        (&["frames[0]", "fl_x", "camera_angle_x"], |json| {
            json.as_object_mut().unwrap().retain(|key, _| !key.starts_with("fl_"));
        }),
        (&["frames[0]", "FISHEYE624"], |json| json["camera_model"] = json!("FISHEYE624")),
        (&["frames[1]", "distortion"], |json| json["frames"][1]["k1"] = json!(-90.0)),
        (&["frames[5]", "k2"], |json| json["frames"][5]["k2"] = json!([0.0])),
    ];
    for (parts, spoil) in spoils {
        let (_folder, path) = capture(spoil);
        assert_format_error(&path, parts);
        assert_format_error(&path, &["transforms.json"]);
    }
    let (_folder, path) = capture(|_| ());
    let text = fs::read(&path).unwrap();
    fs::write(&path, &text[..text.len() / 2]).unwrap();
    assert_format_error(&path, &["transforms.json", "line"]);
    assert!(matches!(Capture::open("no/such.json"), Err(Error::Io { .. })));
}

#[test]
fn photos_are_matched_by_the_end_of_their_path() {
    let (cameras, _) = cameras();
    let names = ["left/000.png", "right/000.png", "right/001.png"];
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    write_transforms(&path, &cameras[..3], &names).unwrap();
    let poses = Capture::open(&path).unwrap();
    let matched = poses.for_photos(&["/a/right/000.png", "somewhere/001.png", "/a/left/000.png"]).unwrap();
    assert_same_cameras(&matched, &[cameras[1], cameras[2], cameras[0]]);
    for (photo, reason) in [("/a/000.png", "tells"), ("/a/002.png", "002.png")] {
        let refused = assert_refused(poses.for_photos(&[photo]), &[reason]);
        assert!(matches!(refused, Error::Argument { .. }), "{refused}");
    }
    let words = "camera of /b/left/000.png: found left/000.png, as of /a/left/000.png";
    assert_refused(poses.for_photos(&["/a/left/000.png", "/b/left/000.png"]), &[words]);
    assert!(poses.for_photos(&["/a/left/000.png"; 2]).is_ok(), "one photo, given twice");
}

#[test]
fn captures_have_sound_cameras() {
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/captures");
    let Ok(entries) = fs::read_dir(&captures) else {
        eprintln!("../shared/captures is absent: its cameras are not read");
        return;
    };
    let folders: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_dir()).collect();
    assert!(!folders.is_empty());
    for folder in folders {
        let poses = Capture::open(&folder).unwrap();
        let photos: Vec<PathBuf> = poses.frames.iter().map(|frame| frame.photo.clone().expect("photo")).collect();
        let on_disk = fs::read_dir(folder.join("images")).unwrap().count();
        assert_eq!((photos.len(), &poses.warnings), (on_disk, &vec![]), "{}", folder.display());
        let size = Image::size(&photos[0]).unwrap();
        let cameras = poses.for_photos(&photos).unwrap();
        let json: Value = serde_json::from_slice(&fs::read(folder.join("transforms.json")).unwrap()).unwrap();
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("{} {i}", folder.display())).unwrap();
            assert_eq!((camera.intrinsics.width, camera.intrinsics.height), size);
            // The last column, in any axes.
            let rows = &json["frames"][i]["transform_matrix"];
            let center = DVec3::from_array([0, 1, 2].map(|row: usize| rows[row][3].as_f64().unwrap()));
            assert_eq!(camera.pose.translation, center);
            assert!(camera.view_matrix().transform_point3(center).length() < 1e-9 * (1.0 + center.length()));
        }
        let points = points(&folder.join("points.ply"));
        let in_view = |camera: &Camera| {
            let view = camera.view_matrix();
            let seen = points.iter().filter(|point| projects_inside(&camera.intrinsics, view, **point)).count();
            seen * 100 > points.len()
        };
        let blind = cameras.iter().filter(|camera| !in_view(camera)).count();
        assert_eq!(blind, 0, "{}: cameras that see less than 1 % of the points", folder.display());
    }
}

fn projects_inside(lens: &Intrinsics, view: DMat4, point: DVec3) -> bool {
    let seen = view.transform_point3(point);
    let pixel = lens.matrix() * (seen / seen.z);
    seen.z > 0.0
        && (0.0..=f64::from(lens.width)).contains(&pixel.x)
        && (0.0..=f64::from(lens.height)).contains(&pixel.y)
}

/// 3 floats, 3 bytes, a float and a short.
fn points(path: &Path) -> Vec<DVec3> {
    let bytes = fs::read(path).unwrap();
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let float = |row: &[u8], i: usize| f64::from(f32::from_le_bytes(row[4 * i..4 * i + 4].try_into().unwrap()));
    bytes[end..].chunks_exact(21).map(|row| DVec3::new(float(row, 0), float(row, 1), float(row, 2))).collect()
}
