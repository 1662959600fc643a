use crate::{
    gpu::{Recorder, Tensor},
    kernels::render::Pack,
    ops::row_chunks,
};

/// Pixel layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelLayout {
    /// f32 RGBA, unclamped: `VK_FORMAT_R32G32B32A32_SFLOAT`.
    RgbaF32,
    /// 8-bit RGBA, as [`crate::types::Image::from_rgb_f32`]: `VK_FORMAT_R8G8B8A8_UNORM`.
    Rgba8,
    /// 8-bit BGRA: `VK_FORMAT_B8G8R8A8_UNORM`.
    Bgra8,
}

impl PixelLayout {
    pub fn bytes(self) -> usize {
        if self == Self::RgbaF32 { 16 } else { 4 }
    }
}

pub(super) fn record(rec: &mut Recorder, frames: Tensor, layout: PixelLayout) -> Tensor {
    if layout == PixelLayout::RgbaF32 {
        return frames;
    }
    let pixels = frames.bytes() as usize / PixelLayout::RgbaF32.bytes();
    let packed = rec.tensor::<u32>("packed", pixels);
    for part in row_chunks(rec, pixels, &[size_of::<[f32; 4]>(), size_of::<u32>()]) {
        let kernel = Pack {
            frames: frames.slice::<[f32; 4]>(part.start, part.len()),
            packed: packed.slice::<u32>(part.start, part.len()),
            count: part.len() as u32,
            blue_first: layout == PixelLayout::Bgra8,
        };
        rec.dispatch(kernel, part.len());
    }
    packed
}
