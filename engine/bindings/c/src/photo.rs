//! Photos from files and bytes, and pictures to files.

use super::{
    picture::{zs_image, zs_pixel_format},
    pointers::{Versioned, array, borrow, destroy, produce, read_given, text, write_versioned},
    status::{guard, zs_status},
};
use std::ffi::{c_char, c_void};
use zipsplat::types::Image;

/// A decoded photo in host memory.
pub struct zs_photo {
    pub(super) image: Image,
}

/// Opens a PNG, JPEG or WebP, recognized by content. Applies the EXIF orientation, drops alpha and
/// keeps the high byte of 16-bit samples. COLMAP cameras refer to unrotated pixels: use
/// zs_capture_open_photo for them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_open(path: *const c_char, photo: *mut *mut zs_photo) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(zs_photo { image: Image::open(unsafe { text(path, "path") }?)? });
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

/// Decodes a photo from memory, as zs_photo_open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_from_memory(
    data: *const c_void,
    size: usize,
    photo: *mut *mut zs_photo,
) -> zs_status {
    // SAFETY: the caller's array of that size.
    let decode =
        || Ok(zs_photo { image: Image::decode(unsafe { array(data.cast::<u8>(), size, "bytes of a photo") }?)? });
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, decode) }
}

/// Returns the photo's pixels (ZS_PIXEL_RGB8), which point into the photo.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_get_image(photo: *const zs_photo, image: *mut zs_image) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let Image { width, height, rgb } = &unsafe { borrow(photo, "photo") }?.image;
        let (pixels, format) = (rgb.as_ptr().cast(), zs_pixel_format::ZS_PIXEL_RGB8 as i32);
        let found = zs_image { format, width: *width, height: *height, pixels, ..Versioned::defaults() };
        // SAFETY: the caller's structure.
        unsafe { write_versioned(image, found) }
    })
}

/// Destroys a photo.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_destroy(photo: *mut zs_photo) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(photo) }
}

/// Writes a PNG of 8 bits per channel without alpha. An existing file is replaced atomically.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_save_png(image: *const zs_image, path: *const c_char) -> zs_status {
    guard(|| {
        // SAFETY: a structure or NULL, a string or NULL.
        let (image, path) = unsafe { (read_given(image)?, text(path, "path")?) };
        // SAFETY: the caller's pixels.
        Ok(unsafe { image.image("image") }?.save_png(path)?)
    })
}
