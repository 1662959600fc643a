use crate::calls::*;
use std::ptr::{null, null_mut};
use zipsplat::{Camera, Edit, Scene};
use zipsplat_c::{zs_edit_kind::*, zs_status::*, *};
use zipsplat_tests::scenes::random_scene;

fn edit(kind: zs_edit_kind, numbers: &[f64]) -> zs_edit {
    let mut edit = zs_edit { kind: kind as i32, ..Versioned::new() };
    edit.numbers[..numbers.len()].copy_from_slice(numbers);
    edit
}

fn edited(
    scenes: &[&Object<zs_scene>],
    edits: &[zs_edit],
    cameras: &[zs_camera],
) -> Result<(Scene, Vec<usize>, Vec<usize>), zs_status> {
    let handles: Vec<*const zs_scene> = scenes.iter().map(|scene| scene.handle.cast_const()).collect();
    let mut counts = vec![usize::MAX; edits.len()];
    let mut sources = vec![usize::MAX; scenes.iter().map(|scene| read(scene).len()).sum()];
    let (e, c, n, s) = (edits.as_ptr(), cameras.as_ptr(), counts.as_mut_ptr(), sources.as_mut_ptr());
    let scene = Object::try_new(|out| unsafe {
        zs_scene_edit(handles.as_ptr(), handles.len(), e, edits.len(), c, cameras.len(), n, s, out)
    })?;
    let scene = read(&scene);
    sources.truncate(scene.len());
    Ok((scene, counts, sources))
}

#[test]
fn edits_equal_the_engines_and_count() {
    let (a, b) = (random_scene(200, 1, 0.1), random_scene(100, 0, 0.2));
    let [first, second] = [&a, &b].map(scene_of);
    let camera = Camera::from_hfov_deg(64, 48, 50.0);
    let edits = [
        edit(ZS_EDIT_CROP_BOX, &[-3.0, -3.0, 0.0, 3.0, 3.0, 5.5]),
        edit(ZS_EDIT_CROP_SPHERE, &[0.0, 0.0, 3.0, 4.0]),
        edit(ZS_EDIT_MIN_VIEWS, &[1.0]),
        edit(ZS_EDIT_TRANSLATE, &[1.0, 2.0, 3.0]),
        edit(ZS_EDIT_ROTATE, &[10.0, 20.0, 30.0]),
        edit(ZS_EDIT_SCALE, &[2.0]),
        edit(ZS_EDIT_MIN_OPACITY, &[0.1]),
        edit(ZS_EDIT_MAX_SIZE, &[0.35]),
        edit(ZS_EDIT_MIN_NEIGHBORS, &[1.0, 2.0]),
        edit(ZS_EDIT_CLEAN, &[]),
        edit(ZS_EDIT_SH_DEGREE, &[0.0]),
        edit(ZS_EDIT_DECIMATE, &[0.5]),
        edit(ZS_EDIT_SORT, &[]),
        edit(ZS_EDIT_LEVEL, &[]),
    ];
    let (found, counts, sources) = edited(&[&first, &second], &edits, &[zs_camera::from(&camera)]).expect("a scene");
    let engine: Vec<Edit> = edits
        .iter()
        .map(|edit| {
            let (name, form) = Edit::FORMS[edit.kind as usize];
            let count = if form.is_empty() { 0 } else { form.split(',').count() };
            Edit::new(name, &edit.numbers[..count]).expect("a valid edit")
        })
        .collect();
    let expected = Scene::concat(a, b).expect("alike").edit(&engine, &[camera]).expect("a scene");
    assert_eq!((found, sources), (expected.scene, expected.sources));
    assert_eq!(counts, expected.reports.iter().map(|report| report.after).collect::<Vec<_>>());
    assert!(counts.last().is_some_and(|count| (1..150).contains(count)), "{counts:?}");
}

#[test]
fn invalid_edits_name_the_field() {
    let scene = scene_of(&random_scene(20, 0, 0.1));
    let fails = |edits: &[zs_edit], words: &[&str]| {
        refused(edited(&[&scene], edits, &[]), ZS_ERROR_ARGUMENT, words);
    };
    fails(&[zs_edit { kind: 14, ..Versioned::new() }], &["kind", "14", "zs_edit_kind"]);
    fails(&[edit(ZS_EDIT_SCALE, &[2.0, 3.0])], &["scale", "3", "0"]);
    fails(&[edit(ZS_EDIT_SCALE, &[-2.0])], &["scale", "-2"]);
    fails(&[edit(ZS_EDIT_MIN_VIEWS, &[1.0])], &["min-views", "no cameras"]);
    fails(&[edit(ZS_EDIT_CROP_SPHERE, &[0.0, 0.0, 90.0, 1.0])], &["crop-sphere", "no Gaussian"]);
    let tagged = scene_of(&Scene { antialiased: true, ..random_scene(20, 0, 0.1) });
    refused(edited(&[&scene, &tagged], &[], &[]), ZS_ERROR_ARGUMENT, &["merge", "antialiased"]);
    assert!(edited(&[&tagged, &tagged], &[], &[]).expect("a scene").0.antialiased);
    refused(edited(&[], &[], &[]), ZS_ERROR_ARGUMENT, &["scenes", "0", "1 or more"]);
    let one = [scene.handle.cast_const()];
    let edit = |scenes, count, edits, edit_count| {
        Object::try_new(|out| unsafe {
            zs_scene_edit(scenes, count, edits, edit_count, null(), 0, null_mut(), null_mut(), out)
        })
    };
    refused(edit(null(), 1, null(), 0), ZS_ERROR_ARGUMENT, &["scenes", "NULL"]);
    refused(edit(one.as_ptr(), 1, null(), 1), ZS_ERROR_ARGUMENT, &["edits", "NULL"]);
    refused(edit([null()].as_ptr(), 1, null(), 0), ZS_ERROR_ARGUMENT, &["scene", "NULL"]);
    assert_eq!(read(&made(edit(one.as_ptr(), 1, null(), 0))), read(&scene));
}
