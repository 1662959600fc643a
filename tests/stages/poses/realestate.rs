use super::{LENS, assert_format_error, assert_same_pose, cameras, put_photos};
use zipsplat_tests::prelude::*;

fn written(folder: &Path, cameras: &[Camera], spoil: impl Fn(usize, String) -> String) -> std::path::PathBuf {
    let (w, h) = (f64::from(LENS.width), f64::from(LENS.height));
    let lens = [LENS.fx / w, LENS.fy / h, LENS.cx / w, LENS.cy / h].map(|value| format!("{value:?}")).join(" ");
    let mut text = "https://www.example.org/watch?v=abc\n".to_owned();
    for (i, camera) in cameras.iter().enumerate() {
        let view = camera.pose.inverse().matrix().transpose().to_cols_array();
        let rows = view[..12].iter().map(|value| format!("{value:?}")).collect::<Vec<_>>().join(" ");
        text += &spoil(i, format!("{} {lens} 0 0 {rows}\n", 33_000 * i));
    }
    let path = folder.join("images.txt");
    fs::write(&path, text).unwrap();
    path
}

#[test]
fn frames_are_read_with_the_size_of_their_pictures() {
    let (cameras, _) = cameras();
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..7).filter(|i| *i != 3).map(|i| format!("images/{}.png", 33_000 * i)).collect();
    put_photos(folder.path(), &names);
    let poses = Capture::open(written(folder.path(), &cameras, |_, line| line)).unwrap();
    assert_eq!(poses.frames.len(), 6);
    assert!(
        poses.warnings[0].contains("1 frames left out") && poses.warnings[0].contains("99000"),
        "{:?}",
        poses.warnings
    );
    for (frame, truth) in poses.frames.iter().zip(cameras.iter().enumerate().filter(|(i, _)| *i != 3)) {
        assert_eq!(frame.name, (33_000 * truth.0).to_string());
        assert_same_pose(&frame.camera.pose, &truth.1.pose, truth.0);
        let found = frame.camera.intrinsics;
        assert_eq!((found.width, found.height), (LENS.width, LENS.height));
        let off = [found.fx - LENS.fx, found.fy - LENS.fy, found.cx - LENS.cx, found.cy - LENS.cy];
        assert!(off.iter().all(|off| off.abs() < 1e-9), "{found:?}");
    }
}

#[test]
fn spoiled_lines_are_named() {
    let (cameras, _) = cameras();
    let folder = tempfile::tempdir().unwrap();
    put_photos(folder.path(), &["images/0.png".into(), "images/33000.png".into()]);
    let spoiled = |spoil: fn(String) -> String| {
        written(folder.path(), &cameras, |i, line| if i == 1 { spoil(line) } else { line })
    };
    assert_format_error(&spoiled(|line| line.replacen(" 0 0 ", " 0 ", 1)), &["line 3", "18 numbers", "19"]);
    assert_format_error(&spoiled(|line| line.replacen(" 0 0 ", " 0 nan ", 1)), &["line 3", "nan"]);
    let turned = |line: String| {
        line.split(' ').enumerate().map(|(i, x)| if i == 7 { "3" } else { x }).collect::<Vec<_>>().join(" ")
    };
    assert_format_error(&spoiled(turned), &["line 3", "rotation"]);
}
