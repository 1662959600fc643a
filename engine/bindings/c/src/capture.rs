//! Captures: photos and their cameras, as a file says them.

use super::{
    photo::zs_photo,
    picture::zs_camera,
    pointers::{borrow, destroy, optional_text, produce, text, write_versioned},
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{CString, c_char},
    path::Path,
    ptr::null,
};
use zipsplat::types::poses::{Frame, Poses, read_poses};

/// The posed photos of a capture. It never changes, so any number of threads may use it at the same time.
pub struct zs_capture {
    pub(super) poses: Poses,
    names: Vec<CString>,
    paths: Vec<Option<CString>>,
    notes: CString,
}

impl From<Poses> for zs_capture {
    fn from(poses: Poses) -> Self {
        let path = |frame: &Frame| Some(c_text(frame.photo.as_ref()?.to_str()?));
        Self {
            names: poses.frames.iter().map(|frame| c_text(&frame.name)).collect(),
            paths: poses.frames.iter().map(path).collect(),
            notes: c_text(&poses.notes.join("\n")),
            poses,
        }
    }
}

impl zs_capture {
    fn frame(&self, index: usize) -> Result<&Frame, Failure> {
        let frames = &self.poses.frames;
        let expected = || format!("a number below {}", frames.len());
        frames.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))
    }
}

fn c_text(text: &str) -> CString {
    CString::new(text.replace('\0', " ")).expect("no NUL")
}

/// Reads the cameras of photos: a transforms.json of instant-ngp or nerfstudio, a COLMAP model's folder, text or binary, or a
/// folder that has one of these. Axes become OpenCV's; world and unit stay the file's. No photo is read but for its size, where
/// the file does not have it. `path` is UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open(path: *const c_char, capture: *mut *mut zs_capture) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(read_poses(unsafe { text(path, "path") }?)?.into());
    // SAFETY: the caller's pointer.
    unsafe { produce(capture, open) }
}

/// Says how many photos a capture has, and what was ignored or left out in reading it, a note a line. The text is the capture's
/// own memory, there until it is destroyed. `notes` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_get_count(
    capture: *const zs_capture,
    count: *mut usize,
    notes: *mut *const c_char,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let capture = unsafe { borrow(capture, "capture") }?;
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(count, capture.names.len(), "count") }?;
        if !notes.is_null() {
            // SAFETY: not NULL, and the caller's to write.
            unsafe { notes.write(capture.notes.as_ptr()) };
        }
        Ok(())
    })
}

/// Says what photo number `index` is: the camera that took it, where lens distortion is undone a pinhole camera; its name as the
/// file writes it; and where it lies, NULL where it was not found. Texts are the capture's own memory, there until it is destroyed.
/// Pointers for what is not wanted may be NULL. Set the camera's struct_size before the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_get(
    capture: *const zs_capture,
    index: usize,
    camera: *mut zs_camera,
    name: *mut *const c_char,
    path: *mut *const c_char,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let capture = unsafe { borrow(capture, "capture") }?;
        let found = zs_camera::from(&capture.frame(index)?.camera);
        if !camera.is_null() {
            // SAFETY: the caller's structure.
            unsafe { write_versioned(camera, found) }?;
        }
        let texts = [
            (name, capture.names[index].as_ptr()),
            (path, capture.paths[index].as_ref().map_or(null(), |path| path.as_ptr())),
        ];
        for (to, text) in texts.into_iter().filter(|(to, _)| !to.is_null()) {
            // SAFETY: not NULL, and the caller's to write.
            unsafe { to.write(text) };
        }
        Ok(())
    })
}

/// Finds the number of the photo that lies at `path` (UTF-8) by its file name; where several have it, by the longest common end of
/// the path. Where none has it, `index` gets the number of photos. ZS_ERROR_ARGUMENT where several match as well.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_find(
    capture: *const zs_capture,
    path: *const c_char,
    index: *mut usize,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL, a string or NULL.
        let (poses, path) = unsafe { (&borrow(capture, "capture")?.poses, text(path, "path")?) };
        let found = poses.frame_of(path)?;
        let at = poses.frames.iter().position(|frame| found.is_some_and(|found| std::ptr::eq(frame, found)));
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(index, at.unwrap_or(poses.frames.len()), "index") }
    })
}

/// Reads photo number `index` as its camera sees it: the pixels as they are stored, whatever the EXIF orientation says, and without
/// the distortion of its lens. `path` (UTF-8) is where it lies, NULL where the capture says it does.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open_photo(
    capture: *const zs_capture,
    index: usize,
    path: *const c_char,
    photo: *mut *mut zs_photo,
) -> zs_status {
    let open = || {
        // SAFETY: an object or NULL, a string or NULL.
        let (capture, path) = unsafe { (borrow(capture, "capture")?, optional_text(path, "path")?) };
        let frame = capture.frame(index)?;
        let path = path.map(Path::new).or(frame.photo.as_deref());
        let path = path.ok_or_else(|| {
            Failure::argument(format!("photo {}", frame.name), "none", "one where the capture says it is, or a path")
        })?;
        Ok(zs_photo { image: frame.open(path)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

/// Destroys a capture. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_destroy(capture: *mut zs_capture) {
    // SAFETY: an object that the caller gives up, or NULL.
    unsafe { destroy(capture) }
}

/// # Safety
/// `to` is NULL or can be written.
unsafe fn put(to: *mut usize, value: usize, name: &str) -> Result<(), Failure> {
    if to.is_null() {
        return Err(Failure::argument(name, "NULL", "where to put it"));
    }
    // SAFETY: not NULL, and the caller's promise.
    unsafe { to.write(value) };
    Ok(())
}
