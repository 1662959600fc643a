//! Edits of scenes.

use super::{
    camera::zs_camera,
    pointers::{array, borrow, produce, read_array},
    scene::zs_scene,
    status::{Failure, zs_status},
};
use zipsplat::{Camera, Edit, Edited, Scene};

/// Kind of an edit, with its numbers. Lengths are in world units.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_edit_kind {
    /// Keeps centers in a box: lower corner x, y, z, upper corner x, y, z.
    ZS_EDIT_CROP_BOX = 0,
    /// Keeps centers in a sphere: center x, y, z, radius.
    ZS_EDIT_CROP_SPHERE = 1,
    /// Moves the scene: x, y, z.
    ZS_EDIT_TRANSLATE = 2,
    /// Rotates about the origin: degrees about x, then y, then z.
    ZS_EDIT_ROTATE = 3,
    /// Scales about the origin: factor.
    ZS_EDIT_SCALE = 4,
    /// Rotates about the origin: the cameras' mean up becomes -y.
    ZS_EDIT_LEVEL = 5,
    /// Drops smaller opacities: opacity.
    ZS_EDIT_MIN_OPACITY = 6,
    /// Drops larger Gaussians: largest standard deviation.
    ZS_EDIT_MAX_SIZE = 7,
    /// Drops isolated Gaussians: least number of others, radius.
    ZS_EDIT_MIN_NEIGHBORS = 8,
    /// Drops Gaussians whose center few cameras' pictures contain: least number of cameras.
    ZS_EDIT_MIN_VIEWS = 9,
    /// Drops floaters: faint or isolated Gaussians, with cameras also those far outside their
    /// pictures.
    ZS_EDIT_CLEAN = 10,
    /// Lowers the degree of spherical harmonics: degree.
    ZS_EDIT_SH_DEGREE = 11,
    /// Merges similar neighbors: number of Gaussians left, or a fraction below 1.
    ZS_EDIT_DECIMATE = 12,
    /// Sorts by opacity times the two largest scales, largest first.
    ZS_EDIT_SORT = 13,
}

pub(super) type zs_edit_kind_value = i32;

/// An edit.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_edit {
    /// sizeof(zs_edit).
    pub struct_size: u32,
    /// Kind.
    pub kind: zs_edit_kind_value,
    /// Numbers of the kind; the others are 0.
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

/// Merges `scenes`, one or more in one world, all antialiased or none, and applies `edits` in
/// order. `cameras`, in that world, are for ZS_EDIT_LEVEL, ZS_EDIT_MIN_VIEWS and ZS_EDIT_CLEAN;
/// edits that move the scene move them, too. `gaussian_counts` is NULL or gets the number of
/// Gaussians after each edit. `sources` is NULL or gets, for each Gaussian of the result, the
/// index of the one that it was among those of `scenes` together; of several merged, the most
/// visible. It needs room for all of them. Edits that leave none fail.
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
            (handles, read_array(edits, edit_count, "edits")?, read_array(cameras, camera_count, "cameras")?)
        };
        // SAFETY: the caller's objects.
        let scenes = handles.iter().map(|handle| unsafe { borrow(*handle, "scene") });
        let scenes = scenes.collect::<Result<Vec<&zs_scene>, _>>()?;
        let Some((first, others)) = scenes.split_first() else {
            return Err(Failure::argument("number of scenes", 0, "1 or more"));
        };
        let edits = edits.iter().map(zs_edit::edit).collect::<Result<Vec<Edit>, _>>()?;
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
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
