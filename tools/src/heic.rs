use crate::{
    decode::{AS_PPM, decode, exif_of, input, read_ppm, save_jpeg, save_jpeg_of_focal},
    file_names::unique_stems,
    process,
    session::{Session, Stage},
};
use std::{
    io::Read,
    path::{Path, PathBuf},
    process::Command,
};
use zipsplat::{
    Error, Result,
    types::{Image, is_heic_start, open_file},
};

/// Detects HEIC by first bytes; false for unreadable files.
pub fn is_heic(path: &Path) -> bool {
    let mut start = [0; 12];
    open_file(path).is_ok_and(|mut file| file.read_exact(&mut start).is_ok()) && is_heic_start(&start)
}

/// Converts to upright JPEGs in order: `IMG_1.HEIC` to `IMG_1.jpg`.
pub fn to_jpeg(session: &Session<'_>, ffmpeg: &Path, pictures: &[&PathBuf], folder: &Path) -> Result<Vec<PathBuf>> {
    let named: Vec<(String, &&PathBuf)> = unique_stems(pictures).into_iter().zip(pictures).collect();
    let (photos, _) = session.stage("read HEIC", |stage| {
        stage.each(&named, |(stem, picture)| {
            let image = read(ffmpeg, picture, stage).map_err(|error| advised(picture, error))?;
            let photo = folder.join(format!("{stem}.jpg"));
            match focal_length(picture) {
                Some(focal) => save_jpeg_of_focal(&image, focal, &photo)?,
                None => save_jpeg(&image, &photo)?,
            }
            Ok(photo)
        })
    })?;
    Ok(photos)
}

/// In millimeters for 35 mm film, by EXIF, to tell a phone's lenses apart.
fn focal_length(picture: &Path) -> Option<u16> {
    let read = exif_of(picture)?;
    let field = read.get_field(exif::Tag::FocalLengthIn35mmFilm, exif::In::PRIMARY)?;
    field.value.get_uint(0)?.try_into().ok().filter(|focal| *focal > 0)
}

fn read(ffmpeg: &Path, picture: &Path, stage: &Stage<'_>) -> Result<Image> {
    let (mut pictures, mut joined) = (0, false);
    // Without an output ffmpeg prints the streams and fails.
    process::run(Command::new(ffmpeg).args(["-nostdin", "-hide_banner"]).args(input(picture)), stage, |line| {
        pictures += usize::from(line.contains("Stream #") && line.contains("Video:"));
        joined |= line.contains("Tile Grid");
        Ok(())
    })?;
    // Older ffmpeg versions return only the first of a phone's tiles.
    if pictures > 1 && !joined {
        return Err(Error::format(picture, None, "ffmpeg finds tiles and cannot join them: 7.1 and later can"));
    }
    let mut image = None;
    let options = [&["-frames:v", "1"], &AS_PPM[..]].concat();
    let messages = decode(ffmpeg, picture, &options, stage, read_ppm, |read| {
        image = Some(read);
        Ok(())
    })?;
    image.ok_or_else(|| Error::format(picture, None, format!("ffmpeg gives no picture: {messages}")))
}

fn advised(picture: &Path, error: Error) -> Error {
    let why = match error {
        Error::Cancelled => return error,
        Error::Format { reason, .. } => reason,
        other => other.to_string(),
    };
    match Image::size(picture) {
        Err(Error::Format { reason, .. }) => Error::format(picture, None, format!("{reason} ({why})")),
        Err(other) => other,
        Ok(_) => Error::format(picture, None, why),
    }
}
