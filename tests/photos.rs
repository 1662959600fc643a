use zipsplat::types::Image;
use zipsplat_verify::noise::Noise;

pub fn noise(width: u32, height: u32, seed: u64) -> Image {
    Noise::new(seed).image(width, height)
}

/// Adds an EXIF segment with an orientation and an end marker to a JPEG.
pub fn with_orientation(jpeg: &[u8], orientation: u8) -> Vec<u8> {
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xd9]);
    let mut bytes = vec![0xff, 0xd8, 0xff, 0xe1, 0, exif.len() as u8 + 2];
    bytes.extend(exif);
    bytes.extend(&jpeg[2..]);
    bytes
}
