mod apng;
mod ffmpeg;
mod gif;

use crate::{process::check, session::Stage};
use std::{
    fmt::Display,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{Camera, Image},
};

/// Delays are in hundredths of a second; viewers slow down those below two.
const GIF_MAX_FPS: u16 = 50;
pub const MAX_FPS: u16 = 240;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Gif,
    Apng,
    Mp4,
}

pub struct Animation {
    path: PathBuf,
    format: Format,
    fps: u16,
    ffmpeg: PathBuf,
}

/// Dropping it unfinished leaves no file.
pub trait Encoder {
    fn push(&mut self, images: &[Image]) -> Result<()>;

    fn finish(self: Box<Self>, stage: &Stage<'_>) -> Result<()>;
}

impl Animation {
    pub fn new(path: &Path, fps: u16, ffmpeg: &Path) -> Result<Self> {
        let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
        let format = match extension.as_deref() {
            Some("gif") => Format::Gif,
            Some("png" | "apng") => Format::Apng,
            Some("mp4") => Format::Mp4,
            _ => {
                return Err(Error::argument(
                    "--video",
                    path.display(),
                    "a file that ends in .gif, .apng, .png or .mp4",
                ));
            }
        };
        if path.metadata().is_ok_and(|found| !found.is_file()) {
            return Err(Error::argument("--video", format!("{}, no regular file", path.display()), "one, or none yet"));
        }
        let (what, most) = match format {
            Format::Gif => ("--fps of a GIF", GIF_MAX_FPS),
            Format::Apng | Format::Mp4 => ("--fps", MAX_FPS),
        };
        if !(1..=most).contains(&fps) {
            return Err(Error::argument(what, fps, format!("1 to {most}")));
        }
        if format == Format::Mp4 {
            check(ffmpeg, "ffmpeg", "an installed ffmpeg for MP4 (see --ffmpeg); .gif and .apng need none")?;
        }
        Ok(Self { path: path.into(), format, fps, ffmpeg: ffmpeg.into() })
    }

    pub fn begin(&self, size: (u32, u32), frames: usize) -> Result<Box<dyn Encoder>> {
        Ok(match self.format {
            Format::Gif => Box::new(gif::Gif::begin(&self.path, size, self.fps)?),
            Format::Apng => Box::new(apng::Apng::begin(&self.path, size, self.fps, frames)?),
            Format::Mp4 => Box::new(ffmpeg::Ffmpeg::begin(&self.ffmpeg, &self.path, size, self.fps)?),
        })
    }
}

pub fn common_size(cameras: &[Camera]) -> Result<(u32, u32)> {
    let size = |camera: &Camera| (camera.intrinsics.width, camera.intrinsics.height);
    let first = cameras.first().map(size).unwrap_or_default();
    match cameras.iter().position(|camera| size(camera) != first) {
        Some(other) => {
            let (width, height) = size(&cameras[other]);
            let expected = format!("{}x{}, the first one's, or --size for all", first.0, first.1);
            Err(Error::argument(format!("size of camera {other}"), format!("{width}x{height}"), expected))
        }
        None => Ok(first),
    }
}

fn failed(path: &Path) -> impl Fn(Box<dyn std::error::Error + Send + Sync>) -> Error {
    move |error| Error::io(path, std::io::Error::other(error))
}

fn side<T: TryFrom<u32>>(side: u32, format: impl Display) -> Result<T> {
    T::try_from(side).map_err(|_| Error::argument(format!("size of a {format}"), side, "fewer pixels a side"))
}
