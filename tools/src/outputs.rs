//! Checked before any work, written atomically.

use crate::{session::Session, stamp::entries, table::counted};
use clap::Args;
use png::{BitDepth, ColorType, Compression};
use serde::Serialize;
use std::{
    fmt::Display,
    fs::File,
    io::{Read, Seek, SeekFrom},
    path::Path,
};
use zipsplat::{
    Error, Result,
    types::{Image, Origin, SaveOptions, Scene, SceneFormat, Unfinished, World, spz_coarsening, write_atomic},
};

/// Levels of 16-bit depth per world unit.
pub const DEPTH_LEVELS: f32 = 1000.0;
pub const MADE_BY: &str = "zipsplat";
pub const LOG_START: &str = "zipsplat: what COLMAP said";
/// Bytes searched at a file's ends.
const SEARCHED: u64 = 1 << 16;
/// File signatures with author marks. `.splat` has none.
const MARKS: [(&[u8], &[u8]); 24] = [
    (b"\x89PNG", b"tEXtSoftware\0zipsplat"),
    (b"ply\n", b"\ncomment zipsplat"),
    (b"\x1f\x8b", b"zipsplat"),
    (b"PK\x03\x04", b"\"generator\":\"zipsplat"),
    (b"glTF", b"\"generator\":\"zipsplat "),
    (b"{", b"\"generator\":\"zipsplat "),
    (b"{", b"\"generator\": \"zipsplat\""),
    (b"# generator: zipsplat\n", b""),
    (b"GIF8", b"zipsplat"),
    (b"\0\0\0", b"zipsplat"),
    (b"<!doctype html>", b"<meta name=generator content=zipsplat>"),
    (b"ZSSCENES", b"ZSSCENES"),
    (LOG_START.as_bytes(), b""),
    (b"", b"\"zipsplat.architecture\""),
    (b"", b"\"zipsplat.depth_architecture\""),
    (b"", b"\"zipsplat.photos\""),
    (b"", b"\"zipsplat.scene_sha256\""),
    (b"view,psnr,ssim,nearest_psnr", b"view,psnr"),
    (b"name,psnr,ssim,lpips\n", b"name,psnr"),
    (b"views,precision,weights", b"views,"),
    (b"capture,error\n", b"capture,error"),
    (b"generator,protocol,method", b"zipsplat"),
    (b"<!-- zipsplat -->", b"<!-- zipsplat"),
    (b"Method,P,K", b"Method,P,K"),
];

#[derive(Args, Clone, Copy)]
pub struct Overwrite {
    /// Replace files that zipsplat did not write; its own are always replaced
    #[arg(long)]
    overwrite: bool,
}

impl Overwrite {
    pub fn is_given(self) -> bool {
        self.overwrite
    }

    pub fn check_file(self, path: &Path) -> Result<()> {
        check_file(path)?;
        self.check_replaced([path])
    }

    pub fn check_scene(self, path: &Path) -> Result<()> {
        self.check_file(path)?;
        if SceneFormat::of_extension(path).is_none() {
            let expected = format!("a file that ends in {}", SceneFormat::EXTENSIONS);
            return Err(Error::argument("--output", path.display(), expected));
        }
        Ok(())
    }

    pub fn check_replaced<P: AsRef<Path>>(self, files: impl IntoIterator<Item = P>) -> Result<()> {
        let mut files = files.into_iter();
        match files.find(|file| !self.overwrite && is_file(file.as_ref()) && !is_own(file.as_ref())) {
            Some(file) => {
                let why = match SceneFormat::of_extension(&file) {
                    Some(SceneFormat::Splat) => " (a .splat does not say)",
                    Some(SceneFormat::Spz) => " (an SPZ 4 does not say)",
                    _ => "",
                };
                let expected = format!("one that zipsplat wrote{why}, or none; another name, or --overwrite");
                Err(Error::argument("file to replace", file.as_ref().display(), expected))
            }
            None => Ok(()),
        }
    }
}

fn is_file(path: &Path) -> bool {
    path.metadata().is_ok_and(|found| found.is_file() && found.len() > 0)
}

pub fn is_own(path: &Path) -> bool {
    let read = || {
        let (mut file, mut bytes) = (File::open(path)?, Vec::new());
        file.by_ref().take(SEARCHED).read_to_end(&mut bytes)?;
        let from = file.metadata()?.len().saturating_sub(SEARCHED).max(bytes.len() as u64);
        file.seek(SeekFrom::Start(from))?;
        file.take(SEARCHED).read_to_end(&mut bytes)?;
        Ok::<_, std::io::Error>(bytes)
    };
    let holds = |bytes: &[u8], mark: &[u8]| mark.is_empty() || bytes.windows(mark.len()).any(|window| window == mark);
    read().is_ok_and(|bytes| MARKS.iter().any(|(start, mark)| bytes.starts_with(start) && holds(&bytes, mark)))
}

/// Removes `own` files of a longer earlier run: names of at least three digits, from `count` on,
/// with `extension`.
pub fn remove_stale(folder: &Path, count: usize, extension: &str, own: impl Fn(&Path) -> bool) -> Result<()> {
    for path in entries(folder)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let digits =
            name.split('.').next().filter(|digits| digits.len() >= 3 && digits.bytes().all(|b| b.is_ascii_digit()));
        let number = digits.and_then(|digits| digits.parse::<usize>().ok());
        let is_alike = path.extension().is_some_and(|found| found == extension);
        if is_alike && number.is_some_and(|number| number >= count) && is_file(&path) && own(&path) {
            std::fs::remove_file(&path).map_err(|error| Error::io(&path, error))?;
        }
    }
    Ok(())
}

/// Creates and removes a temporary file beside `path`.
fn check_file(path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if path.is_dir() || path.file_name().is_none() {
        return Err(Error::argument("output", format!("the folder {}", path.display()), "a file"));
    }
    match folder {
        Some(folder) if !folder.is_dir() => Err(Error::argument("output folder", folder.display(), "one that exists")),
        // Pipes and devices are written directly.
        _ if path.exists() && !path.is_file() => Ok(()),
        _ => Unfinished::begin(path).map(drop),
    }
}

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

/// Writes a scene with its world for `render`. Returns notes on properties that the format drops.
pub fn save_scene(path: &Path, scene: &Scene, options: &SaveOptions, world: Option<&World>) -> Result<Vec<String>> {
    scene.save_in(path, options, world)?;
    let (mut notes, file) = (Vec::new(), path.display());
    let Some(format) = SceneFormat::of_extension(path) else { return Ok(notes) };
    if format == SceneFormat::Spz {
        notes.extend(spz_coarsening(scene));
    }
    if scene.sh_degree > 0 && !format.keeps_view_dependence() {
        notes.push(format!("{file} stores one color per Gaussian: view-dependent color is left out"));
    }
    if scene.antialiased && !format.keeps_antialiased() {
        notes.push(format!("{file} cannot say that the scene is antialiased: `render` needs --antialiased"));
    }
    if let Some(Origin::Photo(photo)) = world.map(|world| &world.origin).filter(|_| !format.keeps_world(options)) {
        let need = format!("`render` needs --relative-to {photo}");
        notes.push(format!("{file} cannot say that its world is the camera of {photo}: {need}"));
    }
    Ok(notes)
}

#[derive(Serialize)]
pub struct Failure {
    pub capture: String,
    pub error: String,
}

pub const FAILURES: &str = "failures.csv";

impl Failure {
    pub fn new(capture: impl Display, error: &Error) -> Self {
        Self { capture: capture.to_string(), error: error.to_string() }
    }

    /// Later captures would fail alike.
    pub fn is_of_all(error: &Error) -> bool {
        matches!(error, Error::Cancelled | Error::DeviceLost | Error::NoDevice(_))
    }
}

/// Notes failures with their file. The command then ends with exit code 1.
pub fn note_failures(session: &mut Session<'_>, folder: &Path, failures: &[Failure], what: &str) {
    if !failures.is_empty() {
        session.note(format!("{}: {}", folder.join(FAILURES).display(), counted(failures.len(), what)));
        session.code = 1;
    }
}

pub fn and_others(mut text: String, others: &[(usize, &str)]) -> String {
    others.iter().filter(|(count, _)| *count > 0).for_each(|(count, what)| text += &format!("; {count} {what}"));
    text
}

pub fn save_json(path: &Path, value: &impl Serialize) -> Result<()> {
    write_atomic(path, |out| {
        serde_json::to_writer_pretty(&mut *out, value)?;
        writeln!(out)
    })
}

/// RFC 4180.
pub fn save_csv(path: &Path, rows: &[impl Serialize]) -> Result<()> {
    let mut table = csv::Writer::from_writer(Vec::new());
    rows.iter().for_each(|row| table.serialize(row).expect("flat rows of one type, written to memory"));
    let table = table.into_inner().expect("written to memory");
    write_atomic(path, |out| out.write_all(&table))
}

pub fn size_of(path: &Path) -> Result<u64> {
    Ok(path.metadata().map_err(|error| Error::io(path, error))?.len())
}

pub fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(|error| Error::io(path, error))
}

pub fn save_picture(path: &Path, image: &Image) -> Result<()> {
    save_png(path, [image.width, image.height], ColorType::Rgb, BitDepth::Eight, &image.rgb, None)
}

pub fn save_alpha(path: &Path, width: u32, height: u32, alpha: &[f32]) -> Result<()> {
    let levels: Vec<u8> = alpha.iter().map(|a| (a.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    save_png(path, [width, height], ColorType::Grayscale, BitDepth::Eight, &levels, None)
}

/// 16-bit gray with its scale, saturated.
pub fn save_depth(path: &Path, size: [u32; 2], depth: &[f32], levels: f32) -> Result<()> {
    // Casting saturates; PNG is big-endian.
    let rounded: Vec<u8> = depth.iter().flat_map(|d| ((d * levels).round() as u16).to_be_bytes()).collect();
    save_png(path, size, ColorType::Grayscale, BitDepth::Sixteen, &rounded, Some(levels))
}

fn save_png(
    path: &Path,
    [width, height]: [u32; 2],
    color: ColorType,
    depth: BitDepth,
    bytes: &[u8],
    levels_per_unit: Option<f32>,
) -> Result<()> {
    write_atomic(path, |out| {
        let mut encoder = png::Encoder::new(out, width, height);
        encoder.set_color(color);
        encoder.set_depth(depth);
        encoder.set_compression(Compression::Fast);
        encoder.add_text_chunk("Software".into(), MADE_BY.into())?;
        if let Some(levels) = levels_per_unit {
            encoder.add_text_chunk("depth_levels_per_unit".into(), levels.to_string())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(bytes)?;
        Ok(writer.finish()?)
    })
}
