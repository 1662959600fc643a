use crate::calls::*;
use std::{
    ffi::{CStr, c_char},
    path::Path,
    ptr::{null, null_mut},
};
use tempfile::TempDir;
use zipsplat::{
    reconstruct::ReconstructOptions,
    types::{
        Camera, Distortion, Intrinsics, Lens, Orbit,
        poses::{Capture, CaptureView, write_frames},
        preprocess::{fit, view_cameras},
    },
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::compare::assert_same;

const COUNT: usize = 3;

fn capture(points: bool) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(folder.path().join("images")).expect("a folder");
    let orbit = Orbit { center: glam::DVec3::new(1.0, 2.0, 30.0), radius: 8.0 };
    let distortion =
        Distortion::Perspective { numerator: [0.05, 0.0, 0.0, 0.0], denominator: [0.0; 3], tangential: [0.0; 2] };
    let intrinsics = Intrinsics::from_fov(SIDE, SIDE, 1.0, 1.0);
    let mut frames = Vec::new();
    for (i, (photo, pose)) in photos(COUNT as u32).iter().zip(orbit.sweep(COUNT, 5.0, 40.0, -10.0)).enumerate() {
        let name = format!("images/{i}.png");
        photo.save_png(folder.path().join(&name)).expect("a photo can be written");
        let lens = Some(Lens { intrinsics, distortion, view: 0 });
        frames.push(CaptureView { name, photo: None, camera: Camera { intrinsics, pose }, lens });
    }
    if points {
        let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 33\n";
        std::fs::write(folder.path().join("points.ply"), text).expect("points can be written");
    }
    write_frames(folder.path().join("transforms.json"), &frames, None).expect("cameras can be written");
    folder
}

fn open(path: &Path) -> Object<zs_capture> {
    let path = c_string(path.to_str().expect("UTF-8"));
    Object::new(|out| unsafe { zs_capture_open(path.as_ptr(), out) })
}

fn text(pointer: *const c_char) -> String {
    if pointer.is_null() {
        return String::new();
    }
    unsafe { CStr::from_ptr(pointer) }.to_str().expect("UTF-8").to_owned()
}

struct Contents {
    cameras: Vec<zs_camera>,
    names: Vec<String>,
    paths: Vec<String>,
    notes: String,
}

fn all(capture: &Object<zs_capture>) -> Contents {
    let mut info = zs_capture_info::new();
    ok(unsafe { zs_capture_get_info(capture.handle, &mut info) });
    let notes = text(info.warnings);
    let mut contents = Contents { cameras: Vec::new(), names: Vec::new(), paths: Vec::new(), notes };
    for i in 0..info.view_count {
        let mut view = zs_capture_view::new();
        contents.cameras.push(unsafe {
            ok(zs_capture_get_view(capture.handle, i, &mut view));
            *view.camera
        });
        contents.names.push(text(view.name));
        contents.paths.push(text(view.path));
    }
    contents
}

fn photo(capture: &Object<zs_capture>, index: usize) -> Object<zs_image_buffer> {
    Object::new(|out| unsafe { zs_capture_open_image(capture.handle, index, null(), out) })
}

fn pixels(photo: &Object<zs_image_buffer>) -> zs_image {
    let mut image = image_of(&zipsplat::Image::new(1, 1, vec![0; 3]).expect("a picture"));
    ok(unsafe { zs_image_buffer_get_image(photo.handle, &mut image) });
    image
}

#[test]
fn photos_and_cameras_are_rusts() {
    let folder = capture(false);
    let contents = all(&open(folder.path()));
    let expected = Capture::open(folder.path()).expect("cameras");
    assert_eq!(contents.names, ["images/0.png", "images/1.png", "images/2.png"]);
    assert_eq!(contents.notes, "");
    let capture = open(&folder.path().join("transforms.json"));
    for (i, frame) in expected.frames.iter().enumerate() {
        let (camera, Camera { intrinsics, pose }) = (&contents.cameras[i], &frame.camera);
        assert_eq!(camera.rotation, pose.rotation.transpose().to_cols_array());
        assert_eq!((camera.translation, camera.fx), (pose.translation.to_array(), intrinsics.fx));
        assert_ne!(camera.fx, Intrinsics::from_fov(SIDE, SIDE, 1.0, 1.0).fx, "the pinhole's, not the lens's");
        assert_eq!(Path::new(&contents.paths[i]), frame.photo.as_ref().expect("it is there"));
        let (photo, expected) = (photo(&capture, i), frame.open(&contents.paths[i]).expect("a photo"));
        let image = pixels(&photo);
        let rgb = unsafe { std::slice::from_raw_parts(image.pixels.cast::<u8>(), expected.rgb.len()) };
        assert_same("pixels", rgb, &expected.rgb);
    }
}

#[test]
fn photos_are_found_by_name() {
    let folder = capture(false);
    let capture = open(folder.path());
    for (path, expected) in [("elsewhere/images/1.png", 1), ("2.png", 2), ("3.png", COUNT)] {
        let (path, mut index) = (c_string(path), usize::MAX);
        ok(unsafe { zs_capture_find(capture.handle, path.as_ptr(), &mut index) });
        assert_eq!(index, expected);
    }
}

#[test]
fn the_unit_is_found_from_the_capture() {
    let (device, mut scenes) = (open_device(), Vec::new());
    let model = model(&device);
    for points in [false, true] {
        let folder = capture(points);
        let capture = open(folder.path());
        let (contents, photos) = (all(&capture), [0, 1, 2].map(|i| photo(&capture, i)));
        let images: Vec<_> = photos.iter().map(pixels).collect();
        let options = zs_reconstruct_options {
            scene_scale: ZS_SCENE_SCALE_AUTO,
            camera_count: COUNT,
            cameras: contents.cameras.as_ptr(),
            capture: capture.handle,
            ..reconstruct_options()
        };
        let in_c = read(&reconstruct(&model, &images, &options));
        let poses = Capture::open(folder.path()).expect("cameras");
        let view = |frame: &CaptureView| fit(&frame.open(frame.photo.as_ref().unwrap()).unwrap(), SIDE, SIDE).unwrap();
        let views: Vec<_> = poses.frames.iter().map(view).collect();
        let cameras: Vec<_> = poses.frames.iter().map(|frame| frame.camera).collect();
        let cameras = view_cameras(&cameras, &views).expect("cameras");
        let unit = poses.scene_scale(None, &cameras, &poses.frames[0].camera.pose).expect("a unit").length;
        let images: Vec<_> = views.into_iter().map(|view| view.image).collect();
        let request =
            ReconstructOptions { cameras: Some(cameras), scene_scale: Some(unit), ..ReconstructOptions::default() };
        let expected = rust_scene(&checkpoint(), &images, &request);
        assert_same(&format!("means, unit {unit}"), in_c.means.as_flattened(), expected.means.as_flattened());
        scenes.push(in_c);
    }
    assert_ne!(scenes[0].means, scenes[1].means, "points say another distance than axes");
}

#[test]
fn captures_of_arrays_are_written_and_read() {
    let folder = tempfile::tempdir().expect("a folder");
    photos(1)[0].save_png(folder.path().join("a.png")).expect("a photo can be written");
    let cameras = [camera(SIDE, SIDE, 0.25), camera(SIDE, SIDE, -0.5)];
    let names = [c"a.png", c"b.png"];
    let view =
        |(camera, name): (&zs_camera, &CStr)| zs_capture_view { name: name.as_ptr(), camera, ..Versioned::new() };
    let views: Vec<_> = cameras.iter().zip(names).map(view).collect();
    let create = |views: &[zs_capture_view]| {
        Object::try_new(|out| unsafe { zs_capture_create(views.as_ptr(), views.len(), out) })
    };
    let path = folder.path().join("transforms.json");
    let text = c_string(path.to_str().expect("UTF-8"));
    ok(unsafe { zs_capture_save(made(create(&views)).handle, text.as_ptr()) });
    let contents = all(&open(&path));
    assert_eq!(contents.names, ["a.png", "b.png"]);
    assert_eq!(Path::new(&contents.paths[0]), folder.path().join("a.png"));
    assert_eq!(contents.paths[1], "");
    for (found, camera) in contents.cameras.iter().zip(&cameras) {
        assert_eq!((found.translation, found.fx, found.width), (camera.translation, camera.fx, SIDE));
    }
    for wrong in [
        zs_capture_view { reserved: 1, ..views[0] },
        zs_capture_view { name: null(), ..views[0] },
        zs_capture_view { camera: null(), ..views[0] },
    ] {
        assert_eq!(create(&[views[0], wrong]).err(), Some(ZS_ERROR_ARGUMENT));
    }
}

#[cfg(unix)]
#[test]
fn saved_captures_find_their_photos_and_points() {
    let folder = capture(true);
    let path = folder.path().join("deep/transforms.json");
    std::fs::create_dir(folder.path().join("deep")).expect("a folder");
    let text = c_string(path.to_str().expect("UTF-8"));
    let here = std::env::current_dir().expect("a working directory");
    let up: std::path::PathBuf = here.components().skip(1).map(|_| "..").collect();
    let relative = up.join(folder.path().strip_prefix("/").expect("an absolute path"));
    ok(unsafe { zs_capture_save(open(&relative).handle, text.as_ptr()) });
    let [first, saved] = [folder.path(), &path].map(|path| {
        let Capture { frames, points, .. } = Capture::open(path).expect("a capture");
        let photos = frames.into_iter().map(|frame| frame.photo.expect("a photo"));
        photos.chain(points).map(|path| path.canonicalize().expect("a file")).collect::<Vec<_>>()
    });
    assert!(first == saved && saved.len() == COUNT + 1, "{first:?}, {saved:?}");
}

#[test]
fn what_is_no_capture_is_refused() {
    let folder = capture(false);
    let capture = open(folder.path());
    let (mut out, mut index) = (null_mut(), 0);
    let open = |path: &Path, out: &mut *mut zs_capture| {
        let path = c_string(path.to_str().expect("UTF-8"));
        unsafe { zs_capture_open(path.as_ptr(), out) }
    };
    fails(open(&folder.path().join("none"), &mut out), ZS_ERROR_IO, &["none"]);
    fails(open(&folder.path().join("images"), &mut out), ZS_ERROR_ARGUMENT, &["images", "transforms.json"]);
    unsafe {
        let view = &mut zs_capture_view::new();
        fails(zs_capture_get_view(capture.handle, COUNT, view), ZS_ERROR_ARGUMENT, &["3", "below 3"]);
        std::fs::remove_file(folder.path().join("images/1.png")).expect("it was there");
        let mut photo = null_mut();
        fails(zs_capture_open_image(capture.handle, 1, null(), &mut photo), ZS_ERROR_IO, &["1.png"]);
        let refused = [
            zs_capture_open(null(), &mut out),
            zs_capture_get_info(null(), null_mut()),
            zs_capture_get_info(capture.handle, null_mut()),
            zs_capture_get_view(null(), 0, null_mut()),
            zs_capture_create(null(), 1, &mut out),
            zs_capture_save(null(), null()),
            zs_capture_find(capture.handle, null(), &mut index),
            zs_capture_find(capture.handle, c"0.png".as_ptr(), null_mut()),
            zs_capture_open_image(null(), 0, null(), &mut photo),
        ];
        assert_eq!(refused, [ZS_ERROR_ARGUMENT; 9]);
        zs_capture_destroy(null_mut());
    }
}
