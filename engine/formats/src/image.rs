//! RGB images.

use std::fmt;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageReader, Limits};

use super::camera::Camera;
use super::file::{open_file, write_atomic};
use crate::{Error, Result};

/// Maximum side of photos.
pub const MAX_SIDE: u32 = 32_768;
const MARK: u64 = 12;
/// Decoding limit in bytes: 350 megapixels of RGB8.
pub const MAX_DECODED_BYTES: u64 = 1 << 30;

/// An 8-bit RGB image.
#[derive(Clone, PartialEq, Eq)]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height][width][rgb]`, top row first.
    pub rgb: Vec<u8>,
    /// `[height][width]`: pixels of 0 are ignored, see [`Image::with_mask`]. `None` keeps all.
    pub mask: Option<Vec<u8>>,
}

impl fmt::Debug for Image {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Image({}x{})", self.width, self.height)
    }
}

impl Image {
    /// Creates an image from `[height][width][rgb]` bytes.
    ///
    /// # Errors
    /// [`Error::Argument`] if a side is zero or the length is not `3 * width * height`.
    pub fn new(width: u32, height: u32, rgb: Vec<u8>) -> Result<Self> {
        let image = Self { width, height, rgb, mask: None };
        image.validate()?;
        Ok(image)
    }

    /// Reads a PNG, JPEG or WebP, identified by content. Applies the EXIF orientation, drops alpha
    /// as Pillow's `convert("RGB")`, and keeps the high byte of 16-bit samples.
    ///
    /// # Errors
    /// [`Error::Format`] for other formats, damage, truncation, or more than 32,768 pixels a side
    /// or 1 GiB decoded.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let (mut decoded, orientation) = decode(path.as_ref())?;
        decoded.apply_orientation(orientation);
        Self::new(decoded.width(), decoded.height(), into_rgb(decoded))
    }

    /// Decodes bytes as [`Image::open`].
    pub fn decode(bytes: &[u8]) -> Result<Self> {
        let name = Path::new("photo in memory");
        refuse_other_kind(name, bytes)?;
        let decoded = decode_bytes(bytes).map_err(|reason| Error::format(name, None, reason));
        let (mut decoded, orientation) = decoded?;
        decoded.apply_orientation(orientation);
        Self::new(decoded.width(), decoded.height(), into_rgb(decoded))
    }

    /// Reads as [`Image::open`], but ignores the EXIF orientation, as COLMAP's cameras do.
    pub fn open_as_stored(path: impl AsRef<Path>) -> Result<Self> {
        let (decoded, _) = decode(path.as_ref())?;
        Self::new(decoded.width(), decoded.height(), into_rgb(decoded))
    }

    /// Reads width and height as of [`Image::open`] from the header.
    pub fn size(path: impl AsRef<Path>) -> Result<(u32, u32)> {
        let ((width, height), orientation) = stored_size(path.as_ref())?;
        Ok(if swaps_sides(orientation) { (height, width) } else { (width, height) })
    }

    /// Reads width and height as of [`Image::open_as_stored`] from the header.
    pub fn size_as_stored(path: impl AsRef<Path>) -> Result<(u32, u32)> {
        Ok(stored_size(path.as_ref())?.0)
    }

    /// Converts a camera of the oriented photo to the stored pixels.
    ///
    /// # Errors
    /// [`Error::Argument`] for mirrored photos.
    pub fn camera_as_stored(path: impl AsRef<Path>, camera: &Camera) -> Result<Camera> {
        Ok(camera.turned(4 - Self::quarter_turns(path)?))
    }

    /// Reads the clockwise quarter turns of the EXIF orientation.
    ///
    /// # Errors
    /// [`Error::Argument`] for mirrored photos.
    pub fn quarter_turns(path: impl AsRef<Path>) -> Result<u32> {
        match stored_size(path.as_ref())?.1 {
            Orientation::NoTransforms => Ok(0),
            Orientation::Rotate90 => Ok(1),
            Orientation::Rotate180 => Ok(2),
            Orientation::Rotate270 => Ok(3),
            mirrored => {
                let what = format!("EXIF orientation of {}", path.as_ref().display());
                Err(Error::argument(what, format!("{mirrored:?}"), "a turn, as cameras write it"))
            }
        }
    }

    /// Turns the picture clockwise by quarter turns.
    pub fn turned(self, quarters: u32) -> Self {
        (0..quarters % 4).fold(self, |Self { width, height, rgb, mask }, _| {
            let (w, h) = (width as usize, height as usize);
            let place = |i: usize| (h - 1 - i % h) * w + i / h;
            let rgb = (0..w * h).flat_map(|i| [0, 1, 2].map(|c| rgb[3 * place(i) + c])).collect();
            let mask = mask.map(|mask| (0..w * h).map(|i| mask[place(i)]).collect());
            Self { width: height, height: width, rgb, mask }
        })
    }

    /// Writes a PNG atomically.
    pub fn save_png(&self, path: impl AsRef<Path>) -> Result<()> {
        self.validate()?;
        write_atomic(path.as_ref(), |out| {
            PngEncoder::new(out)
                .write_image(&self.rgb, self.width, self.height, ExtendedColorType::Rgb8)
                .map_err(std::io::Error::other)
        })
    }

    /// Encodes a JPEG of `quality` 1 to 100.
    ///
    /// # Errors
    /// [`Error::Argument`] for a side longer than a JPEG can have.
    pub fn jpeg(&self, quality: u8) -> Result<Vec<u8>> {
        self.validate()?;
        let mut bytes = Vec::new();
        let encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
        let written = encoder.write_image(&self.rgb, self.width, self.height, ExtendedColorType::Rgb8);
        written.map_err(|error| Error::argument("picture", format!("{self:?}: {error}"), "sides up to 65,535"))?;
        Ok(bytes)
    }

    /// Converts `[height][width][rgb]` floats: clamps to 0..1, multiplies by 255 and truncates, as
    /// the reference's viewer. NaN becomes 0.
    pub fn from_rgb_f32(width: u32, height: u32, rgb: &[f32]) -> Result<Self> {
        Self::new(width, height, rgb.iter().map(|value| (value.clamp(0.0, 1.0) * 255.0) as u8).collect())
    }

    /// Crops from (`left`, `top`).
    ///
    /// # Errors
    /// [`Error::Argument`] if the crop is empty or exceeds the image.
    pub fn crop(&self, left: u32, top: u32, width: u32, height: u32) -> Result<Self> {
        self.validate()?;
        let within = |start: u32, len: u32, all: u32| start.checked_add(len).is_some_and(|end| end <= all);
        if !within(left, width, self.width) || !within(top, height, self.height) {
            let found = format!("{width}x{height} at ({left}, {top})");
            return Err(Error::argument("crop", found, format!("a rectangle within {self:?}")));
        }
        let cut = |values: &[u8], channels: usize| -> Vec<u8> {
            let start = |y: u32| channels * (y as usize * self.width as usize + left as usize);
            let row = |y: u32| &values[start(y)..start(y) + channels * width as usize];
            (top..top + height).flat_map(row).copied().collect()
        };
        let mask = self.mask.as_ref().map(|mask| cut(mask, 1));
        Ok(Self { width, height, rgb: cut(&self.rgb, 3), mask })
    }

    /// Checks as [`Image::new`].
    pub fn validate(&self) -> Result<()> {
        let expected = 3 * u64::from(self.width) * u64::from(self.height);
        if expected == 0 || self.rgb.len() as u64 != expected {
            let found = format!("{} bytes for {}x{}", self.rgb.len(), self.width, self.height);
            return Err(Error::argument("image", found, format!("{expected} bytes and no empty side")));
        }
        match &self.mask {
            Some(mask) if 3 * mask.len() as u64 != expected => {
                Err(Error::argument("mask", format!("{} bytes", mask.len()), format!("{}, one a pixel", expected / 3)))
            }
            _ => Ok(()),
        }
    }
}

/// Arranges images on black in rows of `columns`, each at the top left of equal cells.
///
/// # Errors
/// [`Error::Argument`] without images or columns, or beyond the limits of [`Image::open`].
pub fn contact_sheet(images: &[Image], columns: usize) -> Result<Image> {
    if images.is_empty() || columns == 0 {
        let found = format!("{} images in {columns} columns", images.len());
        return Err(Error::argument("contact sheet", found, "at least one of each"));
    }
    images.iter().try_for_each(Image::validate)?;
    let columns = columns.min(images.len());
    let cell_width = images.iter().map(|image| image.width as usize).max().unwrap_or(0);
    let cell_height = images.iter().map(|image| image.height as usize).max().unwrap_or(0);
    let (width, height) = (cell_width * columns, cell_height * images.len().div_ceil(columns));
    if width.max(height) > MAX_SIDE as usize {
        return Err(Error::argument("contact sheet", format!("{width}x{height}"), format!("sides up to {MAX_SIDE}")));
    }
    let mut rgb = vec![0; 3 * width * height];
    for (i, image) in images.iter().enumerate() {
        let (left, top) = (i % columns * cell_width, i / columns * cell_height);
        let row = 3 * image.width as usize;
        for (y, pixels) in image.rgb.chunks_exact(row).enumerate() {
            let start = 3 * ((top + y) * width + left);
            rgb[start..start + row].copy_from_slice(pixels);
        }
    }
    Image::new(width as u32, height as u32, rgb)
}

/// Reads only the start of other files, which may be large.
fn read(path: &Path) -> Result<Vec<u8>> {
    let failed = |source| Error::io(path, source);
    let (mut file, mut bytes) = (open_file(path)?, Vec::new());
    file.by_ref().take(MARK).read_to_end(&mut bytes).map_err(failed)?;
    refuse_other_kind(path, &bytes)?;
    file.read_to_end(&mut bytes).map_err(failed)?;
    Ok(bytes)
}

fn refuse_other_kind(path: &Path, start: &[u8]) -> Result<()> {
    let Some((kind, advice)) = other_kind(start, path) else { return Ok(()) };
    Err(Error::format(path, None, format!("found {kind}, expected PNG, JPEG or WebP: {advice}")))
}

/// Returns true for a HEIC (brands of ISO/IEC 23008-12).
pub fn is_heic_start(start: &[u8]) -> bool {
    const BRANDS: [&[u8]; 8] = [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"];
    start.get(4..8) == Some(b"ftyp") && start.get(8..12).is_some_and(|brand| BRANDS.contains(&brand))
}

fn other_kind(start: &[u8], path: &Path) -> Option<(&'static str, String)> {
    let quoted = |path: &Path| {
        let path = path.to_string_lossy();
        shlex::try_quote(&path).map_or_else(|_| path.clone().into_owned(), |quoted| quoted.into_owned())
    };
    let ending = |ending: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        quoted(Path::new(&name))
    };
    let photo =
        |program: &str, input: &str, new: &str| format!("`{program} {} {}` converts it", ending(input), ending(new));
    let photos = || {
        let frames = quoted(&path.with_file_name("%03d.jpg"));
        format!("`ffmpeg -i {} -vf fps=2 {frames}` takes two photos a second from it", quoted(path))
    };
    // Brands of ISO/IEC 14496-12; unknown brands are videos.
    match (start.get(4..8), start.get(8..12)) {
        (Some(b"ftyp"), Some(b"avif" | b"avis")) => Some(("an AVIF picture", photo("magick", "", ".png"))),
        _ if is_heic_start(start) => Some(("a HEIC picture", photo("heif-convert", "", ".jpg"))),
        (Some(b"ftyp"), Some(b"crx ")) => None,
        (Some(b"ftyp"), _) => Some(("a video (MP4 or QuickTime)", photos())),
        (_, Some(b"AVI ")) if start.starts_with(b"RIFF") => Some(("a video (AVI)", photos())),
        _ if start.starts_with(&[0x1a, 0x45, 0xdf, 0xa3]) => Some(("a video (Matroska or WebM)", photos())),
        _ if start.starts_with(b"II*\0") || start.starts_with(b"MM\0*") => {
            Some(("a TIFF or a camera's raw picture", photo("magick", "", ".png")))
        }
        // `[0]` is an animation's first frame.
        _ if start.starts_with(b"GIF8") => Some(("a GIF picture", photo("magick", "[0]", ".png"))),
        _ if start.starts_with(b"BM") && start.get(6..10) == Some(&[0; 4]) => {
            Some(("a BMP picture", photo("magick", "", ".png")))
        }
        _ => None,
    }
}

type Decoded<T> = std::result::Result<T, String>;

fn open_decoder(bytes: &[u8]) -> Decoded<(impl ImageDecoder + '_, Orientation)> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    if reader.format().is_none() {
        return Err("found no PNG, JPEG or WebP picture".into());
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODED_BYTES);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    if decoder.total_bytes() > MAX_DECODED_BYTES {
        let (width, height) = decoder.dimensions();
        return Err(format!("{width}x{height} pixels decode to more than {MAX_DECODED_BYTES} bytes"));
    }
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok((decoder, orientation))
}

fn stored_size(path: &Path) -> Result<((u32, u32), Orientation)> {
    let mut start = Vec::new();
    open_file(path)?.take(HEADER).read_to_end(&mut start).map_err(|source| Error::io(path, source))?;
    // A WebP may have its EXIF at the end.
    if (start.starts_with(&JPEG_START) || start.starts_with(PNG_START))
        && let Ok((decoder, orientation)) = open_decoder(&start)
    {
        return Ok((decoder.dimensions(), orientation));
    }
    let bytes = read(path)?;
    let (decoder, orientation) = open_decoder(&bytes).map_err(|reason| Error::format(path, None, reason))?;
    Ok((decoder.dimensions(), orientation))
}

pub(super) fn decode(path: &Path) -> Result<(DynamicImage, Orientation)> {
    decode_bytes(&read(path)?).map_err(|reason| Error::format(path, None, reason))
}

fn decode_bytes(bytes: &[u8]) -> Decoded<(DynamicImage, Orientation)> {
    let (decoder, orientation) = open_decoder(bytes)?;
    let decoded = DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?;
    if bytes.starts_with(&JPEG_START) && !jpeg_has_end(bytes) {
        return Err(NO_JPEG_END.into());
    }
    Ok((decoded, orientation))
}

/// First bytes that hold the size and EXIF of most photos.
const HEADER: u64 = 1 << 18;
const PNG_START: &[u8] = b"\x89PNG";
const JPEG_START: [u8; 2] = [0xff, 0xd8];
const JPEG_SCAN: u8 = 0xda;
const JPEG_END: [u8; 2] = [0xff, 0xd9];
const NO_JPEG_END: &str = "truncated: found a JPEG without its end marker, expected a whole file";

/// Rejects a truncated JPEG without decoding it. Reads the whole file only if its last bytes lack
/// the end marker, as before a trailer.
///
/// # Errors
/// [`Error::Format`] without an end marker.
pub fn check_jpeg_end(path: impl AsRef<Path>) -> Result<()> {
    let path = path.as_ref();
    let failed = |source| Error::io(path, source);
    let (mut file, mut end) = (open_file(path)?, [0; JPEG_END.len()]);
    file.seek(SeekFrom::End(-(JPEG_END.len() as i64))).map_err(failed)?;
    file.read_exact(&mut end).map_err(failed)?;
    if end == JPEG_END || jpeg_has_end(&read(path)?) { Ok(()) } else { Err(Error::format(path, None, NO_JPEG_END)) }
}

/// The decoder pads truncated JPEGs with gray. Searches after the start of scan: earlier thumbnails
/// have end markers, too.
fn jpeg_has_end(bytes: &[u8]) -> bool {
    let mut at = JPEG_START.len();
    while let Some(&[0xff, marker, high, low]) = bytes.get(at..at + 4) {
        match marker {
            JPEG_SCAN => break,
            0xff => at += 1,
            _ => at += 2 + usize::from(u16::from_be_bytes([high, low])),
        }
    }
    bytes.get(at..).is_some_and(|scan| scan.windows(2).any(|pair| pair == JPEG_END))
}

fn swaps_sides(orientation: Orientation) -> bool {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
}

pub(super) fn into_rgb(decoded: DynamicImage) -> Vec<u8> {
    use DynamicImage::{ImageLuma16, ImageLumaA16, ImageRgb16, ImageRgba16};
    match decoded {
        // Pillow keeps the high byte; the crate's conversion rounds.
        ImageLuma16(_) | ImageLumaA16(_) | ImageRgb16(_) | ImageRgba16(_) => {
            decoded.into_rgb16().iter().map(|sample| (sample >> 8) as u8).collect()
        }
        narrow => narrow.into_rgb8().into_raw(),
    }
}
