//! Captures: photos with known cameras.

use super::{
    camera::zs_camera,
    image::zs_image_buffer,
    pointers::{borrow, destroy, optional_text, produce, text, write_versioned},
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{CString, c_char},
    path::Path,
    ptr::null,
};
use zipsplat::types::poses::{Capture, CaptureView};

/// Posed photos of a capture.
pub struct zs_capture {
    pub(super) poses: Capture,
    names: Vec<CString>,
    paths: Vec<Option<CString>>,
    warnings: CString,
}

impl From<Capture> for zs_capture {
    fn from(poses: Capture) -> Self {
        let path = |frame: &CaptureView| Some(c_text(frame.photo.as_ref()?.to_str()?));
        Self {
            names: poses.frames.iter().map(|frame| c_text(&frame.name)).collect(),
            paths: poses.frames.iter().map(path).collect(),
            warnings: c_text(&poses.warnings.join("\n")),
            poses,
        }
    }
}

impl zs_capture {
    fn frame(&self, index: usize) -> Result<&CaptureView, Failure> {
        let frames = &self.poses.frames;
        let expected = || format!("a number below {}", frames.len());
        frames.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))
    }
}

fn c_text(text: &str) -> CString {
    CString::new(text.replace('\0', " ")).expect("no NUL")
}

/// Opens a capture: a transforms.json (instant-ngp or nerfstudio), a COLMAP model folder (text or
/// binary), or a folder that contains either. World and scale stay the file's. Photos are read only
/// for sizes that the file lacks.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open(path: *const c_char, capture: *mut *mut zs_capture) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(Capture::open(unsafe { text(path, "path") }?)?.into());
    // SAFETY: the caller's pointer.
    unsafe { produce(capture, open) }
}

/// Returns the number of photos and, unless NULL, warnings about ignored data, one per line, in
/// the capture's memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_get_count(
    capture: *const zs_capture,
    count: *mut usize,
    warnings: *mut *const c_char,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let capture = unsafe { borrow(capture, "capture") }?;
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(count, capture.names.len(), "count") }?;
        if !warnings.is_null() {
            // SAFETY: not NULL, and the caller's to write.
            unsafe { warnings.write(capture.warnings.as_ptr()) };
        }
        Ok(())
    })
}

/// Returns the undistorted pinhole camera, the name and the path of photo `index`. `name` is as
/// written in the file; the path is NULL if no photo was found. Strings point into the capture.
/// Outputs may be NULL.
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

/// Finds the photo at `path` by file name, then by the longest common path suffix. Without a match
/// `index` is the number of photos. ZS_ERROR_ARGUMENT for an ambiguous match.
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

/// Opens photo `index` undistorted, ignoring the EXIF orientation. `path` overrides the capture's
/// path; NULL keeps it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open_image(
    capture: *const zs_capture,
    index: usize,
    path: *const c_char,
    photo: *mut *mut zs_image_buffer,
) -> zs_status {
    let open = || {
        // SAFETY: an object or NULL, a string or NULL.
        let (capture, path) = unsafe { (borrow(capture, "capture")?, optional_text(path, "path")?) };
        let frame = capture.frame(index)?;
        let path = path.map(Path::new).or(frame.photo.as_deref());
        let path = path.ok_or_else(|| {
            Failure::argument(format!("photo {}", frame.name), "none", "one where the capture says it is, or a path")
        })?;
        Ok(zs_image_buffer { image: frame.open(path)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

/// Destroys a capture.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_destroy(capture: *mut zs_capture) {
    // SAFETY: NULL or given up by the caller.
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
