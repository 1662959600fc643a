//! Images.

use super::{
    pointers::{Versioned, array, describe, destroy, flag, meaning, optional_text, produce, read_given, text},
    status::{Failure, guard, zs_status},
};
use std::ffi::{c_char, c_void};
use zipsplat::{
    Error, Result,
    features::PixelValues,
    types::{Image, MAX_DECODED_BYTES, MAX_SIDE, MaskSource, Masks},
};

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_pixel_format {
    ZS_PIXEL_RGBA8 = 0,
    ZS_PIXEL_RGB8 = 1,
    ZS_PIXEL_BGRA8 = 2,
    ZS_PIXEL_RGB_F32 = 3,
    ZS_PIXEL_RGBA_F32 = 4,
}

use zs_pixel_format::*;

pub(super) type zs_pixel_format_value = i32;

impl zs_pixel_format {
    pub(super) fn of(value: i32) -> Result<Self> {
        let all = [ZS_PIXEL_RGBA8, ZS_PIXEL_RGB8, ZS_PIXEL_BGRA8, ZS_PIXEL_RGB_F32, ZS_PIXEL_RGBA_F32];
        meaning("pixel format", value, "zs_pixel_format", all)
    }

    pub(super) fn bytes(self) -> usize {
        match self {
            ZS_PIXEL_RGB8 => 3,
            ZS_PIXEL_RGBA8 | ZS_PIXEL_BGRA8 => 4,
            ZS_PIXEL_RGB_F32 => 12,
            ZS_PIXEL_RGBA_F32 => 16,
        }
    }

    pub(super) fn has_alpha(self) -> bool {
        !matches!(self, ZS_PIXEL_RGB8 | ZS_PIXEL_RGB_F32)
    }
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_image {
    pub struct_size: u32,
    pub format: zs_pixel_format_value,
    pub width: u32,
    pub height: u32,
    pub stride: i64,
    pub pixels: *const c_void,
    pub mask: *const u8,
    pub mask_stride: i64,
    pub depth: *const f32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_masks {
    pub struct_size: u32,
    pub inverted: u32,
    pub folder: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_pixel_values {
    pub struct_size: u32,
    pub width: u32,
    pub height: u32,
    pub reserved: u32,
    pub values: *const f32,
}

versioned!(zs_image, zs_masks, zs_pixel_values { reserved });

impl From<&PixelValues> for zs_pixel_values {
    fn from(PixelValues { width, height, values, .. }: &PixelValues) -> Self {
        Self { width: *width, height: *height, values: values.as_ptr(), ..Versioned::new() }
    }
}

// SAFETY: the caller does not write the pixels during a call.
unsafe impl Sync for zs_image {}

/// Also the limit of decoded files.
const MAX_PIXELS: u64 = MAX_DECODED_BYTES / 3;

pub struct zs_image_buffer {
    pub(super) image: Image,
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_buffer_open(path: *const c_char, photo: *mut *mut zs_image_buffer) -> zs_status {
    // SAFETY: the caller's arguments.
    let open = || Ok(zs_image_buffer { image: Image::open(unsafe { text(path, "path") }?)? });
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_buffer_open_masked(
    path: *const c_char,
    masks: *const zs_masks,
    photo: *mut *mut zs_image_buffer,
) -> zs_status {
    // SAFETY: the caller's arguments.
    let open = || {
        Ok(zs_image_buffer { image: unsafe { zs_masks::read(masks) }?.open(unsafe { text(path, "path") }?, false)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, open) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_buffer_from_memory(
    data: *const c_void,
    size: usize,
    photo: *mut *mut zs_image_buffer,
) -> zs_status {
    // SAFETY: the caller's array of that size.
    let decode = || {
        Ok(zs_image_buffer { image: Image::decode(unsafe { array(data.cast::<u8>(), size, "bytes of a photo") }?)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(photo, decode) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_buffer_get_image(photo: *const zs_image_buffer, image: *mut zs_image) -> zs_status {
    let of = |photo: &zs_image_buffer| {
        let Image { width, height, rgb, mask } = &photo.image;
        let (pixels, format) = (rgb.as_ptr().cast(), zs_pixel_format::ZS_PIXEL_RGB8 as i32);
        let mask = mask.as_ref().map_or(std::ptr::null(), Vec::as_ptr);
        Ok(zs_image { format, width: *width, height: *height, pixels, mask, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(photo, "photo", image, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_buffer_destroy(photo: *mut zs_image_buffer) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(photo) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_image_save_png(image: *const zs_image, path: *const c_char) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (image, path) = unsafe { (read_given(image)?, text(path, "path")?) };
        // SAFETY: the caller's pixels.
        Ok(unsafe { image.image("image") }?.save_png(path)?)
    })
}

impl zs_image {
    /// # Safety
    /// All rows are readable.
    pub(super) unsafe fn image(&self, name: &str) -> Result<Image> {
        let field = |field: &str| format!("{name}, {field}");
        let (width, height, format) = (self.width, self.height, zs_pixel_format::of(self.format)?);
        let sides = 1..=MAX_SIDE;
        let pixels = u64::from(width) * u64::from(height);
        if !sides.contains(&width) || !sides.contains(&height) || pixels > MAX_PIXELS {
            let expected = format!("sides of 1 to {MAX_SIDE}, at most {MAX_PIXELS} pixels");
            return Err(Error::argument(field("size"), format!("{width} x {height}"), expected));
        }
        if self.pixels.is_null() {
            return Err(Error::argument(field("pixels"), "NULL", "the first pixel"));
        }
        let row_bytes = width as usize * format.bytes();
        let stride = checked_stride(self.stride, row_bytes, height, &field("stride"))?;
        let mut rgb = Vec::new();
        let bytes = 3 * pixels;
        rgb.try_reserve_exact(bytes as usize).map_err(|_| Error::Memory {
            what: field("pixels"),
            needed: bytes,
            available: 0,
        })?;
        for y in 0..height as isize {
            // SAFETY: the caller guarantees readable rows; the stride was checked not to wrap.
            let row = unsafe { std::slice::from_raw_parts(self.pixels.cast::<u8>().offset(y * stride), row_bytes) };
            append_rgb(&mut rgb, row, format);
        }
        if self.mask.is_null() {
            return Ok(Image { width, height, rgb, mask: None });
        }
        let stride = checked_stride(self.mask_stride, width as usize, height, &field("mask_stride"))?;
        // SAFETY: as for the pixels.
        let row = |y: isize| unsafe { std::slice::from_raw_parts(self.mask.offset(y * stride), width as usize) };
        Image { width, height, rgb, mask: None }.with_mask((0..height as isize).flat_map(row).copied().collect())
    }

    /// Returns the known depth of an image whose pixels were read.
    ///
    /// # Safety
    /// As its pixels.
    pub(super) unsafe fn known_depth(&self) -> Result<Option<Vec<f32>>, Failure> {
        if self.depth.is_null() {
            return Ok(None);
        }
        // SAFETY: the caller's array.
        let depth = unsafe { array(self.depth, self.width as usize * self.height as usize, "depth") }?;
        Ok(Some(depth.to_vec()))
    }
}

impl zs_masks {
    /// # Safety
    /// NULL or a structure of its stated size.
    pub(super) unsafe fn read(masks: *const Self) -> Result<Masks, Failure> {
        // SAFETY: the caller's promise.
        let (masks, folder) = unsafe {
            let masks = read_given(masks)?;
            (masks, optional_text(masks.folder, "folder")?)
        };
        let source = folder.map_or(MaskSource::Alpha, |folder| MaskSource::Folder(folder.into()));
        Ok(Masks { source, inverted: flag("inverted", masks.inverted)? })
    }
}

/// Checks a row stride: at least a row, and a picture within the address space.
pub(super) fn checked_stride(stride: i64, row_bytes: usize, height: u32, name: &str) -> Result<isize> {
    let stride = if stride == 0 { row_bytes as i64 } else { stride };
    let fits =
        stride.unsigned_abs() >= row_bytes as u64 && stride.unsigned_abs() <= isize::MAX as u64 / u64::from(height);
    let expected = || format!("0, or at least {row_bytes} either way");
    if fits { Ok(stride as isize) } else { Err(Error::argument(name, stride, expected())) }
}

fn append_rgb(rgb: &mut Vec<u8>, row: &[u8], format: zs_pixel_format) {
    let float = |bytes: &[u8]| {
        let value = f32::from_ne_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
        (value.clamp(0.0, 1.0) * 255.0).round() as u8
    };
    let pixels = row.chunks_exact(format.bytes());
    match format {
        ZS_PIXEL_RGB8 => rgb.extend_from_slice(row),
        ZS_PIXEL_RGBA8 => pixels.for_each(|p| rgb.extend_from_slice(&p[..3])),
        ZS_PIXEL_BGRA8 => pixels.for_each(|p| rgb.extend([p[2], p[1], p[0]])),
        ZS_PIXEL_RGB_F32 | ZS_PIXEL_RGBA_F32 => {
            pixels.for_each(|p| rgb.extend([float(p), float(&p[4..]), float(&p[8..])]));
        }
    }
}
