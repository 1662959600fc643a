use crate::{
    calls::*,
    installation::{Linking, installation, runner, success},
};
use std::{
    ffi::{CStr, c_void},
    ptr::{null, null_mut},
};
use zipsplat::types::{Image, SaveOptions, Scene, SceneFormat};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{
    compare::assert_same,
    scenes::{random_scene, scene_extensions},
};

/// Each thread has one address: no pointer dangles.
#[test]
fn a_message_stays_where_it_is() {
    let open = |path: &str| {
        let path = c_string(path);
        unsafe { zs_scene_open(path.as_ptr(), null(), &mut null_mut()) }
    };
    let before = zs_last_error();
    fails(open("first.ply"), ZS_ERROR_IO, &["first.ply"]);
    fails(open(&format!("second{}", "-".repeat(200))), ZS_ERROR_IO, &["second"]);
    assert_eq!(before, zs_last_error());
    let text = || unsafe { CStr::from_ptr(before) }.to_str().expect("UTF-8").to_owned();
    assert!(text().contains("second"), "{}", text());
    scene_of(&random_scene(3, 0, 0.1));
    assert!(text().contains("second"), "{}", text());
    let other = std::thread::spawn(|| zs_last_error() as usize).join().expect("no panic");
    assert_ne!(other, before as usize);
}

/// C evaluates arguments in any order.
#[test]
fn a_call_and_its_message_stand_in_one_expression() {
    let program = r#"
#include <stdio.h>
#include <string.h>
#include <zipsplat.h>
int main(void) {
    static const char *const paths[] = {"first.ply", "a second file, with a longer name.ply", "third.ply"};
    char line[1000];
    for (int i = 0; i < 3; i++) {
        zs_scene *scene = NULL;
        snprintf(line, sizeof line, "%s: %s", zs_status_name(zs_scene_open(paths[i], NULL, &scene)), zs_last_error());
        if (!strstr(line, "ZS_ERROR_IO: ") || !strstr(line, paths[i])) {
            fprintf(stderr, "%s\n", line);
            return 1;
        }
    }
    return 0;
}
"#;
    success(runner(&installation().compile_text("expression.c", program, Linking::Sanitized)));
}

fn from_memory(bytes: &[u8], format: Option<&str>, drop_invalid: u32) -> Result<Object<zs_scene>, zs_status> {
    let format = format.map(c_string);
    let format = format.as_ref().map_or(null(), |format| format.as_ptr());
    let options = zs_scene_open_options { drop_invalid, format, ..Versioned::new() };
    let (data, size) = (bytes.as_ptr().cast(), bytes.len());
    Object::try_new(|out| unsafe { zs_scene_from_memory(data, size, &options, out) })
}

#[test]
fn scenes_go_to_memory_and_come_back() {
    let truth = random_scene(50, 1, 0.1);
    let scene = scene_of(&truth);
    let folder = tempfile::tempdir().expect("a folder");
    for extension in scene_extensions() {
        let format = c_string(extension);
        let encode = |out| unsafe { zs_scene_to_memory(scene.handle, format.as_ptr(), null(), out) };
        let object = Object::new(encode);
        let (mut data, mut size): (*const c_void, usize) = (null(), 0);
        let bytes = unsafe {
            ok(zs_blob_get(object.handle, &mut data, &mut size));
            std::slice::from_raw_parts(data.cast::<u8>(), size)
        };
        let path = folder.path().join(format!("scene.{extension}"));
        let text = c_string(path.to_str().expect("UTF-8"));
        ok(unsafe { zs_scene_save(scene.handle, text.as_ptr(), null()) });
        assert!(std::fs::read(&path).expect("it was written") == bytes, "{extension}");
        let back = read(&made(from_memory(bytes, Some(extension), 0)));
        assert_same(extension, back.means.as_flattened(), Scene::open(&path).expect("a scene").means.as_flattened());
    }
    let format = c_string("obj");
    let encode = |out| unsafe { zs_scene_to_memory(scene.handle, format.as_ptr(), null(), out) };
    refused(Object::try_new(encode), ZS_ERROR_ARGUMENT, &["format", "obj", ".spz"]);
}

#[test]
fn scenes_in_memory_are_told_apart_and_checked() {
    let mut truth = random_scene(4, 0, 0.1);
    let ply = truth.encode(SceneFormat::Ply, &SaveOptions::default(), None).expect("a valid scene");
    assert_eq!(read(&made(from_memory(&ply, None, 0))).means, truth.means);
    truth.means[1] = [f32::NAN; 3];
    // A .splat, because our writer rejects such values.
    let row = |i: usize| {
        let floats: [f32; 6] = std::array::from_fn(|j| if j < 3 { truth.means[i][j] } else { 0.1 });
        [floats.map(f32::to_le_bytes).as_flattened(), &[9; 8]].concat()
    };
    let bytes: Vec<u8> = (0..4).flat_map(row).collect();
    assert_eq!(from_memory(&bytes, None, 0).err(), Some(ZS_ERROR_FORMAT));
    assert_eq!(from_memory(&bytes, Some("obj"), 0).err(), Some(ZS_ERROR_ARGUMENT));
    assert_eq!(from_memory(&bytes, Some("splat"), 0).err(), Some(ZS_ERROR_FORMAT));
    assert!(message().contains("scene in memory") && message().contains("1 of 4"), "{}", message());
    let scene = made(from_memory(&bytes, Some(".SPLAT"), 1));
    let mut info = zs_scene_info::new();
    ok(unsafe { zs_scene_get_info(scene.handle, &mut info) });
    assert_eq!((info.dropped_count, read(&scene).means), (1, vec![truth.means[0], truth.means[2], truth.means[3]]));
}

#[test]
fn photos_come_from_memory() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("photo.png");
    photos(1)[0].save_png(&path).expect("a photo can be written");
    let bytes = std::fs::read(&path).expect("it was written");
    let decode = |bytes: &[u8]| {
        Object::try_new(|out| unsafe { zs_image_buffer_from_memory(bytes.as_ptr().cast(), bytes.len(), out) })
    };
    let photo = made(decode(&bytes));
    let mut image = zs_image { format: 0, width: 0, height: 0, pixels: null(), ..image_of(&photos(1)[0]) };
    let rgb = unsafe {
        ok(zs_image_buffer_get_image(photo.handle, &mut image));
        std::slice::from_raw_parts(image.pixels.cast::<u8>(), 3 * (image.width * image.height) as usize)
    };
    assert!(Image::open(&path).expect("a photo").rgb == rgb);
    for bad in [&bytes[..bytes.len() / 2], b"no photo", b"", b"\0\0\0\x18ftypheic"] {
        assert_eq!(decode(bad).err(), Some(ZS_ERROR_FORMAT));
        assert!(message().contains("photo in memory"), "{}", message());
    }
}
