//! Photos from files and bytes, and pictures to files.

use super::{
    picture::{zs_image, zs_pixel_format},
    pointers::{Versioned, array, borrow, destroy, produce, read_given, text, write_versioned},
    status::{guard, zs_status},
};
use std::ffi::{c_char, c_void};
use zipsplat::types::Image;

/// A photo, decoded, in host memory. It never changes, so any number of threads may use it at the same time.
pub struct zs_photo {
    pub(super) image: Image,
}

/// Reads a PNG, JPEG or WebP, told apart by content. The EXIF orientation is applied, alpha is dropped, and of 16-bit samples
/// the high byte is kept. Cameras of COLMAP, and of what is built on it, are of the pixels as stored, before that orientation: read
/// photos with such cameras by zs_capture_open_photo. `path` is UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_open(path: *const c_char, photo: *mut *mut zs_photo) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(zs_photo { image: Image::open(unsafe { text(path, "path") }?)? });
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

/// As zs_photo_open, with a file's contents: `size` bytes at `data`, which are not needed any more when this returns.
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

/// Fills `image` with where the photo's pixels are (ZS_PIXEL_RGB8), for zs_reconstruct or to read them: the photo's own
/// memory, there until it is destroyed. Set its struct_size before the call.
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

/// Destroys a photo. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_photo_destroy(photo: *mut zs_photo) {
    // SAFETY: an object that the caller gives up, or NULL.
    unsafe { destroy(photo) }
}

/// Writes a picture in your memory as a PNG of 8 bits a channel, without alpha. The file appears whole or not at all; one of
/// that name is replaced. `path` is UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_save_png(image: *const zs_image, path: *const c_char) -> zs_status {
    guard(|| {
        // SAFETY: a structure or NULL, a string or NULL.
        let (image, path) = unsafe { (read_given(image)?, text(path, "path")?) };
        // SAFETY: the caller's pixels.
        Ok(unsafe { image.image("image") }?.save_png(path)?)
    })
}
