//! Edits of scenes.

use super::{
    camera::{read_cameras, zs_camera},
    pointers::{array, borrow, produce, read_array},
    scene::zs_scene,
    status::{Failure, zs_status},
};
use zipsplat::{Edit, Edited, Scene};

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_edit_kind {
    ZS_EDIT_CROP_BOX = 0,
    ZS_EDIT_CROP_SPHERE = 1,
    ZS_EDIT_TRANSLATE = 2,
    ZS_EDIT_ROTATE = 3,
    ZS_EDIT_SCALE = 4,
    ZS_EDIT_LEVEL = 5,
    ZS_EDIT_MIN_OPACITY = 6,
    ZS_EDIT_MAX_SIZE = 7,
    ZS_EDIT_MIN_NEIGHBORS = 8,
    ZS_EDIT_MIN_VIEWS = 9,
    ZS_EDIT_CLEAN = 10,
    ZS_EDIT_SH_DEGREE = 11,
    ZS_EDIT_DECIMATE = 12,
    ZS_EDIT_SORT = 13,
}

pub(super) type zs_edit_kind_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_edit {
    pub struct_size: u32,
    pub kind: zs_edit_kind_value,
    pub numbers: [f64; 6],
}

versioned!(zs_edit);

impl zs_edit {
    fn edit(&self) -> Result<Edit, Failure> {
        let form = usize::try_from(self.kind).ok().and_then(|kind| Edit::FORMS.get(kind));
        let (name, form) = form.ok_or_else(|| Failure::argument("zs_edit, kind", self.kind, "a zs_edit_kind"))?;
        let count = form.split(',').filter(|number| !number.is_empty()).count();
        let (numbers, others) = self.numbers.split_at(count);
        match others.iter().find(|number| **number != 0.0) {
            Some(other) => Err(Failure::argument(format!("numbers of {name}"), format!("{other} beyond {count}"), "0")),
            None => Ok(Edit::new(name, numbers)?),
        }
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_edit(
    scenes: *const *const zs_scene,
    scene_count: usize,
    edits: *const zs_edit,
    edit_count: usize,
    cameras: *const zs_camera,
    camera_count: usize,
    gaussian_counts: *mut usize,
    sources: *mut usize,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let edit = || {
        // SAFETY: the caller's arrays.
        let (handles, edits, cameras) = unsafe {
            let handles = array(scenes, scene_count, "scenes")?;
            (handles, read_array(edits, edit_count, "edits")?, read_cameras(cameras, camera_count)?)
        };
        // SAFETY: the caller's objects.
        let scenes = handles.iter().map(|handle| unsafe { borrow(*handle, "scene") });
        let scenes = scenes.collect::<Result<Vec<&zs_scene>, _>>()?;
        let Some((first, others)) = scenes.split_first() else {
            return Err(Failure::argument("number of scenes", 0, "1 or more"));
        };
        let edits = edits.iter().map(zs_edit::edit).collect::<Result<Vec<Edit>, _>>()?;
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
        }
        let joined = |scene, other: &&zs_scene| Scene::concat(scene, Scene::clone(&other.scene));
        let merged = others.iter().try_fold(Scene::clone(&first.scene), joined)?;
        let Edited { scene, sources: found, reports } = merged.edit(&edits, &cameras)?;
        if !gaussian_counts.is_null() {
            for (i, report) in reports.iter().enumerate() {
                // SAFETY: the caller has a number for each edit there.
                unsafe { gaussian_counts.add(i).write(report.after) };
            }
        }
        if !sources.is_null() {
            // SAFETY: the caller has room for the Gaussians of all scenes there.
            unsafe { std::ptr::copy_nonoverlapping(found.as_ptr(), sources, found.len()) };
        }
        let origin = |scene: &zs_scene| scene.world.as_ref().map(|world| world.origin.clone());
        let is_kept = scenes.iter().all(|scene| origin(scene) == origin(first)) && !edits.iter().any(Edit::moves);
        let dropped = scenes.iter().map(|scene| scene.dropped).sum();
        Ok(zs_scene { world: first.world.clone().filter(|_| is_kept), dropped, ..scene.into() })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, edit) }
}
