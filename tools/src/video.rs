use crate::{
    cameras::Place,
    decode::{AS_PPM, decode, read_ppm, read_whole, save_jpeg},
    outputs::make_folder,
    process::check,
    scratch::Scratch,
    session::{Session, Stage},
};
use std::{
    io,
    path::{Path, PathBuf},
};
use zipsplat::{Error, Result};

const EXTENSIONS: [&str; 8] = ["mp4", "mov", "m4v", "avi", "mkv", "webm", "3gp", "mts"];
pub const FRAMES: usize = 24;
/// Longer side for measuring sharpness: suppresses noise.
const SIDE: usize = 512;
/// Regular timestamps; otherwise ffmpeg drops and duplicates frames.
const REGULAR: &str = "setpts=N/25/TB";
/// Excludes cover pictures.
const PICTURES: [&str; 2] = ["-map", "0:v:0"];

/// Removed on drop unless kept.
pub struct FrameFolder {
    path: PathBuf,
    kept: bool,
    _scratch: Option<Scratch>,
}

impl FrameFolder {
    pub fn temporary() -> Result<Self> {
        let scratch = Scratch::new()?;
        // The scratch folder removes itself.
        Ok(Self { path: scratch.path().to_owned(), kept: true, _scratch: Some(scratch) })
    }

    /// Creates [`Place::beside`]'s `frames` for a camera file; an existing one stays with
    /// `overwrite`.
    pub fn beside(file: &Path, overwrite: bool) -> Result<Self> {
        let path = Place(file).beside("frames");
        file.parent().map_or(Ok(()), make_folder)?;
        match std::fs::create_dir(&path) {
            Ok(()) => Ok(Self { path, kept: false, _scratch: None }),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && overwrite => {
                Ok(Self { path, kept: true, _scratch: None })
            }
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                let expected = "one that does not exist yet; or --overwrite";
                Err(Error::argument("folder for frames of the video", path.display(), expected))
            }
            Err(source) => Err(Error::io(path, source)),
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn keep(&mut self) {
        self.kept = true;
    }
}

impl Drop for FrameFolder {
    fn drop(&mut self) {
        if !self.kept {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

pub fn is_video(path: &Path) -> bool {
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
    extension.is_some_and(|extension| EXTENSIONS.contains(&extension.as_str()))
}

/// The sharpest frame of each of `count` equal parts, upright and in order, as `start-00042.jpg` by
/// frame number.
pub fn sharpest_frames(
    session: &mut Session<'_>,
    ffmpeg: &Path,
    video: &Path,
    count: usize,
    start: &Path,
) -> Result<Vec<PathBuf>> {
    check(ffmpeg, "ffmpeg", "an installed ffmpeg, which reads videos (`apt install ffmpeg`; see --ffmpeg)")?;
    video.metadata().map_err(|source| Error::io(video, source))?;
    let ((sharpness, messages), _) =
        session.stage("look for sharp frames", |stage| measure_sharpness(ffmpeg, video, stage))?;
    let chosen = sharpest(&sharpness, count);
    if chosen.is_empty() {
        let messages = if messages.is_empty() { messages } else { format!(": {messages}") };
        return Err(Error::format(video, None, format!("no frame that ffmpeg can read{messages}")));
    }
    if !messages.is_empty() {
        let read = sharpness.len();
        session.note(format!("{}: ffmpeg reads {read} frames and finds the file damaged: {messages}", video.display()));
    }
    let (photos, _) = session.stage("take frames", |stage| take(ffmpeg, video, &chosen, start, stage))?;
    Ok(photos)
}

/// Also returns ffmpeg's warnings.
fn measure_sharpness(ffmpeg: &Path, video: &Path, stage: &Stage<'_>) -> Result<(Vec<f64>, String)> {
    let filter = format!("scale={SIDE}:{SIDE}:flags=area,format=gray,{REGULAR}");
    let mut sharpness = Vec::new();
    let messages = decode(
        ffmpeg,
        video,
        &[&PICTURES[..], &["-vf", &filter, "-r", "25", "-f", "rawvideo"]].concat(),
        stage,
        |from| {
            let mut gray = vec![0; SIDE * SIDE];
            Ok(read_whole(from, &mut gray)?.then(|| laplacian_variance(&gray, SIDE)))
        },
        |value| {
            sharpness.push(value);
            stage.name(&format!("look for sharp frames, {}", sharpness.len()));
            Ok(())
        },
    )?;
    Ok((sharpness, messages))
}

/// The first of ties.
fn sharpest(sharpness: &[f64], count: usize) -> Vec<usize> {
    let (all, count) = (sharpness.len(), count.min(sharpness.len()));
    let part = |i: usize| i * all / count..(i + 1) * all / count;
    (0..count).filter_map(|i| part(i).rev().max_by(|a, b| sharpness[*a].total_cmp(&sharpness[*b]))).collect()
}

fn take(ffmpeg: &Path, video: &Path, chosen: &[usize], start: &Path, stage: &Stage<'_>) -> Result<Vec<PathBuf>> {
    let filter = format!("select='{}',{REGULAR}", any_of(chosen));
    let mut photos = Vec::new();
    decode(
        ffmpeg,
        video,
        &[&PICTURES[..], &["-vf", &filter, "-r", "25"], &AS_PPM].concat(),
        stage,
        read_ppm,
        |image| {
            let Some(frame) = chosen.get(photos.len()) else { return Ok(()) };
            let mut path = start.as_os_str().to_owned();
            path.push(format!("-{frame:05}.jpg"));
            let path = PathBuf::from(path);
            save_jpeg(&image, &path)?;
            photos.push(path);
            stage.reach(photos.len() as f64 / chosen.len() as f64)
        },
    )?;
    if photos.len() < chosen.len() {
        let reason = format!("ffmpeg gave {} of {} frames", photos.len(), chosen.len());
        return Err(Error::format(video, None, reason));
    }
    Ok(photos)
}

/// Expression of ffmpeg that is not 0 for these frames. ffmpeg refuses sums of more than 100 terms
/// without parentheses.
fn any_of(frames: &[usize]) -> String {
    match frames {
        [frame] => format!("eq(n,{frame})"),
        _ => {
            let (first, second) = frames.split_at(frames.len() / 2);
            format!("({}+{})", any_of(first), any_of(second))
        }
    }
}

fn laplacian_variance(gray: &[u8], width: usize) -> f64 {
    let height = gray.len() / width;
    let at = |x: usize, y: usize| f64::from(gray[y * width + x]);
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let value = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4.0 * at(x, y);
            (sum, squares, count) = (sum + value, squares + value * value, count + 1.0);
        }
    }
    squares / count - (sum / count) * (sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_gives_its_sharpest_frame() {
        let sharpness = [1.0, 5.0, 2.0, 2.0, 9.0, 1.0, 3.0];
        assert_eq!(sharpest(&sharpness, 3), [1, 2, 4]);
        assert_eq!(sharpest(&sharpness, 1), [4]);
        assert_eq!(sharpest(&sharpness, 100), [0, 1, 2, 3, 4, 5, 6]);
        assert!(sharpest(&[], 3).is_empty());
    }

    #[test]
    fn sums_are_nested() {
        assert_eq!(any_of(&[7]), "eq(n,7)");
        assert_eq!(any_of(&[1, 2, 3, 40]), "((eq(n,1)+eq(n,2))+(eq(n,3)+eq(n,40)))");
    }

    #[test]
    fn blur_lowers_the_variance() {
        let picture = |period: usize| -> Vec<u8> {
            (0..32 * 32).map(|i| if ((i % 32) / period).is_multiple_of(2) { 0 } else { 200 }).collect()
        };
        let (fine, coarse) = (laplacian_variance(&picture(1), 32), laplacian_variance(&picture(8), 32));
        assert!(fine > 4.0 * coarse && coarse > 0.0, "{fine} and {coarse}");
        assert_eq!(laplacian_variance(&[7; 64], 8), 0.0);
    }
}
