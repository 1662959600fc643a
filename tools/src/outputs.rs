//! Where results go: checked before any work, written whole or not at all.

use png::{BitDepth, ColorType, Compression};
use serde::Serialize;
use std::{io::BufReader, path::Path};
use zipsplat::{
    Error, Result,
    types::{
        Image, Scene, SceneFormat, Unfinished, WriteOptions, open_file, write_atomic, write_ply_with_origin,
        write_scene,
    },
};

/// Levels of a depth picture for one world unit.
pub const DEPTH_LEVELS: f32 = 1000.0;
/// Keyword and text in the PNGs that this program draws.
const MADE_BY: [&str; 2] = ["Software", "zipsplat"];

/// Checks that a file can be written at `path`, before anything is computed for it: one is made beside it, and removed.
pub fn check_file(path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if path.is_dir() || path.file_name().is_none() {
        return Err(Error::argument("output", format!("the folder {}", path.display()), "a file"));
    }
    match folder {
        Some(folder) if !folder.is_dir() => Err(Error::argument("output folder", folder.display(), "one that exists")),
        // A pipe or a device is written straight.
        _ if path.exists() && !path.is_file() => Ok(()),
        _ => Unfinished::begin(path).map(drop),
    }
}

/// Checks that files can be written to a folder at `path`, made where it is missing, before anything is computed for it.
pub fn check_folder(path: &Path) -> Result<()> {
    if path.exists() && !path.is_dir() {
        return Err(Error::argument("output", format!("the file {}", path.display()), "a folder"));
    }
    let existing = path.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("."));
    match Unfinished::begin(&existing.join("file")) {
        Err(Error::Io { source, .. }) => Err(Error::io(path, source)),
        tried => tried.map(drop),
    }
}

/// Writes a scene, in a PLY also which photo's camera is its world, where that is known: `render` then reads the file of
/// that photo's cameras as the scene means them.
pub fn save_scene(path: &Path, scene: &Scene, origin: Option<&str>) -> Result<()> {
    match (SceneFormat::of_extension(path), origin) {
        (Some(SceneFormat::Ply), Some(photo)) => write_ply_with_origin(scene, path, photo),
        _ => write_scene(path, scene, &WriteOptions::default()),
    }
}

/// Writes rows as CSV (RFC 4180) under the names of their fields.
pub fn save_csv(path: &Path, rows: &[impl Serialize]) -> Result<()> {
    let table = csv(rows);
    write_atomic(path, |out| out.write_all(table.as_bytes()))
}

/// Rows as CSV under the names of their fields, which are numbers, text or absent.
pub fn csv(rows: &[impl Serialize]) -> String {
    let mut table = csv::Writer::from_writer(Vec::new());
    rows.iter().for_each(|row| table.serialize(row).expect("flat rows of one type, written to memory"));
    let bytes = table.into_inner().expect("written to memory");
    String::from_utf8(bytes).expect("fields are text")
}

/// Makes a folder for files, where there is none.
pub fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(|error| Error::io(path, error))
}

/// Writes a picture.
pub fn save_picture(path: &Path, image: &Image) -> Result<()> {
    save_png(path, [image.width, image.height], (ColorType::Rgb, BitDepth::Eight), &image.rgb)
}

/// Writes alpha in 0..1 as 8-bit grey.
pub fn save_alpha(path: &Path, width: u32, height: u32, alpha: &[f32]) -> Result<()> {
    let levels: Vec<u8> = alpha.iter().map(|a| (a.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    save_png(path, [width, height], (ColorType::Grayscale, BitDepth::Eight), &levels)
}

/// Writes depth in world units as 16-bit grey, [`DEPTH_LEVELS`] a unit; what is farther than that holds is the brightest.
pub fn save_depth(path: &Path, width: u32, height: u32, depth: &[f32]) -> Result<()> {
    // Casting saturates; PNG is big endian.
    let levels: Vec<u8> = depth.iter().flat_map(|d| ((d * DEPTH_LEVELS).round() as u16).to_be_bytes()).collect();
    save_png(path, [width, height], (ColorType::Grayscale, BitDepth::Sixteen), &levels)
}

/// Writes a PNG that says what made it, for [`is_own_picture`].
fn save_png(path: &Path, [width, height]: [u32; 2], (color, depth): (ColorType, BitDepth), bytes: &[u8]) -> Result<()> {
    write_atomic(path, |out| {
        let mut encoder = png::Encoder::new(out, width, height);
        encoder.set_color(color);
        encoder.set_depth(depth);
        encoder.set_compression(Compression::Fast);
        let [keyword, text] = MADE_BY.map(str::to_owned);
        encoder.add_text_chunk(keyword, text)?;
        let mut writer = encoder.write_header()?;
        writer.write_image_data(bytes)?;
        Ok(writer.finish()?)
    })
}

/// Whether this program wrote a picture, so that nobody misses it where it is replaced.
pub fn is_own_picture(path: &Path) -> bool {
    let reader = open_file(path).ok().and_then(|file| png::Decoder::new(BufReader::new(file)).read_info().ok());
    reader.is_some_and(|reader| {
        let texts = &reader.info().uncompressed_latin1_text;
        texts.iter().any(|chunk| [chunk.keyword.as_str(), chunk.text.as_str()] == MADE_BY)
    })
}
