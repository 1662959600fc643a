//! Pixels and cameras.

use super::{
    pointers::{POINTER, Versioned},
    status::Failure,
};
use glam::{DMat3, DVec3};
use std::ffi::c_void;
use zipsplat::types::{Camera, Image, Intrinsics, MAX_DECODED_BYTES, MAX_SIDE, Pose};

/// Pixel formats. Color is sRGB-encoded, from 0 to 1 or 255.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_pixel_format {
    /// 3 bytes: red, green, blue.
    ZS_PIXEL_RGB8 = 1,
    /// VK_FORMAT_R8G8B8A8_UNORM.
    ZS_PIXEL_RGBA8 = 2,
    /// VK_FORMAT_B8G8R8A8_UNORM.
    ZS_PIXEL_BGRA8 = 3,
    /// 3 f32: red, green, blue.
    ZS_PIXEL_RGB_F32 = 4,
    /// VK_FORMAT_R32G32B32A32_SFLOAT.
    ZS_PIXEL_RGBA_F32 = 5,
}

use zs_pixel_format::*;

pub(super) type zs_pixel_format_value = i32;

impl zs_pixel_format {
    pub(super) fn of(value: i32) -> Result<Self, Failure> {
        let all = [ZS_PIXEL_RGB8, ZS_PIXEL_RGBA8, ZS_PIXEL_BGRA8, ZS_PIXEL_RGB_F32, ZS_PIXEL_RGBA_F32];
        let found = all.into_iter().find(|format| *format as i32 == value);
        found.ok_or_else(|| Failure::argument("pixel format", value, "a zs_pixel_format"))
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

/// A photo in the caller's memory, top row first. Alpha is ignored; f32 values are clamped to 0..1
/// and rounded to 8 bits.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_image {
    /// sizeof(zs_image).
    pub struct_size: u32,
    /// Pixel format.
    pub format: zs_pixel_format_value,
    /// 1 to 32768.
    pub width: u32,
    /// 1 to 32768.
    pub height: u32,
    /// Bytes between rows: negative for bottom-up storage, 0 for contiguous rows.
    pub stride: i64,
    /// First pixel of the top row, of any alignment.
    pub pixels: *const c_void,
}

// SAFETY: the caller does not write the pixels during a call.
unsafe impl Sync for zs_image {}

/// A pinhole camera with OpenCV axes: x right, y down, z forward. Intrinsics are in pixels, whose
/// centers are at +0.5.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_camera {
    /// sizeof(zs_camera).
    pub struct_size: u32,
    /// Must be 0.
    pub reserved: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point from the left edge.
    pub cx: f64,
    /// Principal point from the top edge.
    pub cy: f64,
    /// Camera-to-world rotation, row-major: columns are the right, down and forward axes.
    pub rotation: [f64; 9],
    /// Camera center in the world.
    pub translation: [f64; 3],
}

/// Limit of pixels of one photo, shared with decoded files.
const MAX_PIXELS: u64 = MAX_DECODED_BYTES / 3;

// SAFETY: repr(C), four u32, an i64 and a pointer: padding only at the end for 4-byte pointers.
unsafe impl Versioned for zs_image {
    const NAME: &str = "zs_image";
    const FIRST_SIZE: usize = 24 + POINTER;
    fn defaults() -> Self {
        let struct_size = size_of::<Self>() as u32;
        Self { struct_size, format: 0, width: 0, height: 0, stride: 0, pixels: std::ptr::null() }
    }
}

// SAFETY: repr(C), four u32 and f64: no padding.
unsafe impl Versioned for zs_camera {
    const NAME: &str = "zs_camera";
    const FIRST_SIZE: usize = 144;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            reserved: 0,
            width: 0,
            height: 0,
            fx: 0.0,
            fy: 0.0,
            cx: 0.0,
            cy: 0.0,
            rotation: [0.0; 9],
            translation: [0.0; 3],
        }
    }
}

impl From<&Camera> for zs_camera {
    fn from(camera: &Camera) -> Self {
        let Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose } = *camera;
        let (rotation, translation) = (pose.rotation.transpose().to_cols_array(), pose.translation.to_array());
        Self { width, height, fx, fy, cx, cy, rotation, translation, ..Versioned::defaults() }
    }
}

impl zs_camera {
    pub(super) fn camera(&self) -> Result<Camera, Failure> {
        let Self { reserved, width, height, fx, fy, cx, cy, .. } = *self;
        if reserved != 0 {
            return Err(Failure::argument("zs_camera, reserved", reserved, "0"));
        }
        let rotation = DMat3::from_cols_array(&self.rotation).transpose();
        let pose = Pose { rotation, translation: DVec3::from_array(self.translation) };
        Ok(Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose })
    }
}

impl zs_image {
    /// # Safety
    /// All rows are readable.
    pub(super) unsafe fn image(&self, name: &str) -> Result<Image, Failure> {
        let field = |field: &str| format!("{name}, {field}");
        let (width, height, format) = (self.width, self.height, zs_pixel_format::of(self.format)?);
        let sides = 1..=MAX_SIDE;
        let pixels = u64::from(width) * u64::from(height);
        if !sides.contains(&width) || !sides.contains(&height) || pixels > MAX_PIXELS {
            let expected = format!("sides of 1 to {MAX_SIDE}, at most {MAX_PIXELS} pixels");
            return Err(Failure::argument(field("size"), format!("{width} x {height}"), expected));
        }
        if self.pixels.is_null() {
            return Err(Failure::argument(field("pixels"), "NULL", "the first pixel"));
        }
        let row_bytes = width as usize * format.bytes();
        let stride = checked_stride(self.stride, row_bytes, height, &field("stride"))?;
        let mut rgb = Vec::new();
        let bytes = 3 * pixels;
        rgb.try_reserve_exact(bytes as usize).map_err(|_| zipsplat::Error::Memory {
            what: field("pixels"),
            needed: bytes,
            available: 0,
        })?;
        for y in 0..height as isize {
            // SAFETY: the caller guarantees readable rows; the stride was checked not to wrap.
            let row = unsafe { std::slice::from_raw_parts(self.pixels.cast::<u8>().offset(y * stride), row_bytes) };
            append_rgb(&mut rgb, row, format);
        }
        Ok(Image { width, height, rgb })
    }
}

/// Returns the checked row stride: at least a row, within the address space for the whole picture.
pub(super) fn checked_stride(stride: i64, row_bytes: usize, height: u32, name: &str) -> Result<isize, Failure> {
    let stride = if stride == 0 { row_bytes as i64 } else { stride };
    let fits =
        stride.unsigned_abs() >= row_bytes as u64 && stride.unsigned_abs() <= isize::MAX as u64 / u64::from(height);
    let expected = || format!("0, or at least {row_bytes} either way");
    if fits { Ok(stride as isize) } else { Err(Failure::argument(name, stride, expected())) }
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
