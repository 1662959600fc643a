//! Captures: photos with known cameras.

use super::{
    camera::zs_camera,
    image::{zs_image_buffer, zs_masks},
    pointers::{
        Versioned, borrow, c_text, describe, destroy, element, optional_text, produce, put, read_array, read_given,
        text,
    },
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{CString, c_char},
    path::Path,
    ptr::null,
};
use zipsplat::{
    Camera, Capture, Image,
    types::poses::{CaptureView, find_photo, write_frames},
};

pub struct zs_capture {
    pub(super) capture: Capture,
    views: Vec<View>,
    warnings: CString,
}

struct View {
    name: CString,
    path: Option<CString>,
    camera: zs_camera,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_capture_info {
    pub struct_size: u32,
    pub reserved: u32,
    pub view_count: usize,
    pub warnings: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_capture_view {
    pub struct_size: u32,
    pub reserved: u32,
    pub name: *const c_char,
    pub path: *const c_char,
    pub camera: *const zs_camera,
}

versioned!(zs_capture_info { reserved }, zs_capture_view { reserved });

impl From<Capture> for zs_capture {
    fn from(capture: Capture) -> Self {
        let view = |view: &CaptureView| View {
            name: c_text(&view.name),
            path: view.photo.as_ref().and_then(|path| path.to_str()).map(c_text),
            camera: (&view.camera).into(),
        };
        let views = capture.frames.iter().map(view).collect();
        Self { views, warnings: c_text(&capture.warnings.join("\n")), capture }
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open(path: *const c_char, capture: *mut *mut zs_capture) -> zs_status {
    // SAFETY: the caller's arguments.
    let open = || Ok(Capture::open(unsafe { text(path, "path") }?)?.into());
    // SAFETY: the caller's pointer.
    unsafe { produce(capture, open) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_create(
    views: *const zs_capture_view,
    count: usize,
    capture: *mut *mut zs_capture,
) -> zs_status {
    let create = || {
        // SAFETY: the caller's array.
        let views = unsafe { read_array(views, count, "views") }?;
        let view = |(i, view): (usize, &zs_capture_view)| {
            // SAFETY: the caller's arguments.
            let (name, path, camera) = unsafe {
                let (name, path) = (format!("name of view {i}"), format!("path of view {i}"));
                (text(view.name, &name)?, optional_text(view.path, &path)?, read_given(view.camera)?)
            };
            let camera = Camera::from(&camera);
            camera.validate(&format!("camera {i}"))?;
            Ok(CaptureView { name: name.to_owned(), photo: path.map(Into::into), camera, lens: None })
        };
        let frames = views.iter().enumerate().map(view).collect::<Result<_, Failure>>()?;
        Ok(Capture { frames, ..Capture::default() }.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(capture, create) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_save(capture: *const zs_capture, path: *const c_char) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (capture, path) = unsafe { (&borrow(capture, "capture")?.capture, text(path, "path")?) };
        // Readers resolve relative paths from the file's folder.
        let folder = Path::new(path).parent().unwrap_or(Path::new(""));
        let absolute = |path: &Path| std::path::absolute(path).ok()?.into_os_string().into_string().ok();
        let named = |frame: &CaptureView| {
            let found = find_photo(folder, &frame.name).and_then(|path| path.canonicalize().ok());
            let photo = frame.photo.as_deref().filter(|photo| photo.canonicalize().ok() != found);
            let name = photo.and_then(absolute).unwrap_or_else(|| frame.name.clone());
            CaptureView { name, ..frame.clone() }
        };
        let frames: Vec<CaptureView> = capture.frames.iter().map(named).collect();
        Ok(write_frames(path, &frames, capture.points.as_deref().and_then(absolute).as_deref())?)
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_get_info(capture: *const zs_capture, info: *mut zs_capture_info) -> zs_status {
    let of = |zs_capture { views, warnings, .. }: &zs_capture| {
        Ok(zs_capture_info { view_count: views.len(), warnings: warnings.as_ptr(), ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(capture, "capture", info, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_get_view(
    capture: *const zs_capture,
    index: usize,
    view: *mut zs_capture_view,
) -> zs_status {
    let of = |capture: &zs_capture| {
        let View { name, path, camera } = element(&capture.views, index)?;
        let path = path.as_ref().map_or(null(), |path| path.as_ptr());
        Ok(zs_capture_view { name: name.as_ptr(), path, camera, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(capture, "capture", view, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_find(
    capture: *const zs_capture,
    path: *const c_char,
    index: *mut usize,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (capture, path) = unsafe { (&borrow(capture, "capture")?.capture, text(path, "path")?) };
        let found = capture.frame_of(path)?;
        let at = capture.frames.iter().position(|frame| found.is_some_and(|found| std::ptr::eq(frame, found)));
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(index, at.unwrap_or(capture.frames.len()), "index") }
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open_image(
    capture: *const zs_capture,
    index: usize,
    path: *const c_char,
    photo: *mut *mut zs_image_buffer,
) -> zs_status {
    // SAFETY: the caller's arguments.
    unsafe { produce(photo, || open(capture, index, path, |frame, path| frame.open(path))) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_open_masked_image(
    capture: *const zs_capture,
    index: usize,
    path: *const c_char,
    masks: *const zs_masks,
    photo: *mut *mut zs_image_buffer,
) -> zs_status {
    let open = || {
        // SAFETY: the caller's arguments.
        let masks = unsafe { zs_masks::read(masks) }?;
        // SAFETY: the caller's arguments.
        unsafe { open(capture, index, path, |frame, path| frame.open_masked(path, &masks)) }
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

/// # Safety
/// A capture and a string, or NULL.
unsafe fn open(
    capture: *const zs_capture,
    index: usize,
    path: *const c_char,
    open: impl Fn(&CaptureView, &Path) -> zipsplat::Result<Image>,
) -> Result<zs_image_buffer, Failure> {
    // SAFETY: the caller's promise.
    let (capture, path) = unsafe { (borrow(capture, "capture")?, optional_text(path, "path")?) };
    let frame = element(&capture.capture.frames, index)?;
    let path = path.map(Path::new).or(frame.photo.as_deref());
    let path = path.ok_or_else(|| {
        Failure::argument(format!("photo {}", frame.name), "none", "one where the capture says it is, or a path")
    })?;
    Ok(zs_image_buffer { image: open(frame, path)? })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_capture_destroy(capture: *mut zs_capture) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(capture) }
}
