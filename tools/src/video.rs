//! Photos from a video, by an installed ffmpeg.

use crate::{
    process::{POLL, Running, check, failure, listen},
    session::{Session, Stage},
};
use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};
use std::{
    ffi::OsString,
    io::{self, BufRead, BufReader, Read},
    path::{Path, PathBuf},
    process::{ChildStdout, Command, Stdio},
    sync::mpsc::{RecvTimeoutError, channel},
};
use zipsplat::{
    Error, Result,
    types::{Image, write_atomic},
};

/// Extensions of the files that are taken for videos.
const EXTENSIONS: [&str; 8] = ["mp4", "mov", "m4v", "avi", "mkv", "webm", "3gp", "mts"];
/// Photos of a video where nobody says how many.
pub const FRAMES: usize = 24;
/// Sides of the grey pictures in which sharpness is judged: small enough that noise does not count.
const SIDE: usize = 512;
/// One timestamp a frame: ffmpeg drops and doubles frames of others to make them regular.
const REGULAR: &str = "setpts=N/25/TB";
/// Quality of the photos, of 100.
const QUALITY: u8 = 95;

/// A folder for frames, which goes with them unless it is kept.
pub struct FrameFolder {
    path: PathBuf,
    kept: bool,
}

impl FrameFolder {
    /// One that nobody will miss.
    ///
    /// # Errors
    /// [`Error::Io`] where none can be made.
    pub fn temporary() -> Result<Self> {
        let made = tempfile::Builder::new().prefix("zipsplat-").tempdir();
        let path = made.map_err(|source| Error::io(std::env::temp_dir(), source))?.keep();
        Ok(Self { path, kept: false })
    }

    /// `frames` beside a file that will name them. One that exists is taken where `overwrite`, and stays.
    ///
    /// # Errors
    /// [`Error::Argument`] where it exists and is not to be taken, [`Error::Io`] where it cannot be made.
    pub fn beside(file: &Path, overwrite: bool) -> Result<Self> {
        let path = file.with_file_name("frames");
        match std::fs::create_dir(&path) {
            Ok(()) => Ok(Self { path, kept: false }),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && overwrite => Ok(Self { path, kept: true }),
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

    /// Keeps it and what is in it.
    pub fn keep(&mut self) {
        self.kept = true;
    }
}

impl Drop for FrameFolder {
    fn drop(&mut self) {
        if !self.kept {
            // What cannot be removed is left for who can.
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// True where a file is a video, by its extension.
pub fn is_video(path: &Path) -> bool {
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
    extension.is_some_and(|extension| EXTENSIONS.contains(&extension.as_str()))
}

/// Writes the sharpest frame of each of `count` equal parts of a video to a folder, turned as the file says: the name of
/// the video and the number of the frame, such as `clip-00042.jpg`. Returns them in order.
///
/// # Errors
/// [`Error::Argument`] where ffmpeg does not run, [`Error::Format`] in ffmpeg's words where the video cannot be read,
/// [`Error::Io`] where a photo cannot be written, [`Error::Cancelled`].
pub fn sharpest_frames(
    session: &Session<'_>,
    ffmpeg: &Path,
    video: &Path,
    count: usize,
    folder: &Path,
) -> Result<Vec<PathBuf>> {
    check(ffmpeg, "ffmpeg", "an installed ffmpeg, which reads videos (`apt install ffmpeg`; see --ffmpeg)")?;
    video.metadata().map_err(|source| Error::io(video, source))?;
    let (sharpness, _) = session.stage("look for sharp frames", |stage| judge(ffmpeg, video, stage))?;
    let chosen = sharpest(&sharpness, count);
    if chosen.is_empty() {
        return Err(Error::format(video, None, "no frame that ffmpeg can read"));
    }
    let (photos, _) = session.stage("take frames", |stage| take(ffmpeg, video, &chosen, folder, stage))?;
    Ok(photos)
}

/// The sharpness of each frame: the variance of the Laplacian.
fn judge(ffmpeg: &Path, video: &Path, stage: &Stage<'_>) -> Result<Vec<f64>> {
    let filter = format!("scale={SIDE}:{SIDE}:flags=area,format=gray,{REGULAR}");
    let mut sharpness = Vec::new();
    decode(
        (ffmpeg, video),
        &["-vf", &filter, "-r", "25", "-f", "rawvideo"],
        stage,
        |from| {
            let mut grey = vec![0; SIDE * SIDE];
            Ok(read_whole(from, &mut grey)?.then(|| laplacian_variance(&grey, SIDE)))
        },
        |value| {
            sharpness.push(value);
            stage.name(&format!("look for sharp frames, {}", sharpness.len()));
            Ok(())
        },
    )?;
    Ok(sharpness)
}

/// The sharpest frame of each of `count` equal parts, of equal ones the first.
fn sharpest(sharpness: &[f64], count: usize) -> Vec<usize> {
    let (all, count) = (sharpness.len(), count.min(sharpness.len()));
    let part = |i: usize| i * all / count..(i + 1) * all / count;
    (0..count).filter_map(|i| part(i).rev().max_by(|a, b| sharpness[*a].total_cmp(&sharpness[*b]))).collect()
}

/// Writes frames of a video, which are in ascending order.
fn take(ffmpeg: &Path, video: &Path, chosen: &[usize], folder: &Path, stage: &Stage<'_>) -> Result<Vec<PathBuf>> {
    let numbers: Vec<String> = chosen.iter().map(|frame| format!("eq(n,{frame})")).collect();
    let filter = format!("select='{}',{REGULAR}", numbers.join("+"));
    let stem = video.file_stem().unwrap_or_default().to_string_lossy();
    let mut photos = Vec::new();
    decode(
        (ffmpeg, video),
        &["-vf", &filter, "-r", "25", "-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24"],
        stage,
        read_ppm,
        |image| {
            let Some(frame) = chosen.get(photos.len()) else { return Ok(()) };
            let path = folder.join(format!("{stem}-{frame:05}.jpg"));
            write_atomic(&path, |out| {
                let encoder = JpegEncoder::new_with_quality(out, QUALITY);
                let written = encoder.write_image(&image.rgb, image.width, image.height, ExtendedColorType::Rgb8);
                written.map_err(io::Error::other)
            })?;
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

/// Runs ffmpeg on a video with these options for what it makes of it, and gives what `read` reads of that, on a thread of
/// its own, to `take`.
fn decode<T: Send + 'static>(
    (ffmpeg, video): (&Path, &Path),
    options: &[&str],
    stage: &Stage<'_>,
    mut read: impl FnMut(&mut BufReader<ChildStdout>) -> io::Result<Option<T>> + Send + 'static,
    mut take: impl FnMut(T) -> Result<()>,
) -> Result<()> {
    let failed = |source| Error::io(ffmpeg, source);
    let mut command = Command::new(ffmpeg);
    // Named as a file: a path may look like an option or a protocol.
    let mut input = OsString::from("file:");
    input.push(video);
    command.args(["-nostdin", "-loglevel", "error", "-i"]).arg(input).args(["-map", "0:v:0"]).args(options).arg("-");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut running = Running::start(&mut command).map_err(failed)?;
    let said = running.0.stderr.take().map(listen);
    let Some(stdout) = running.0.stdout.take() else { return Ok(()) };
    let (send, items) = channel();
    std::thread::spawn(move || {
        let mut from = BufReader::new(stdout);
        while let Some(item) = read(&mut from).transpose() {
            let broken = item.is_err();
            if send.send(item).is_err() || broken {
                return;
            }
        }
    });
    let mut broken = None;
    loop {
        match items.recv_timeout(POLL) {
            Ok(Ok(item)) => take(item)?,
            Ok(Err(error)) => broken = Some(error),
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) => {}
        }
        stage.check()?;
    }
    let status = running.wait(ffmpeg.as_os_str(), stage)?;
    let said = said.and_then(|said| said.join().ok()).unwrap_or_default();
    match broken {
        None if status.success() => Ok(()),
        // Who is killed says nothing.
        _ if said.trim().is_empty() => Err(failure(ffmpeg, "", broken.map_or(status.to_string(), |e| e.to_string()))),
        _ => Err(Error::format(video, None, said.trim().lines().collect::<Vec<_>>().join("; "))),
    }
}

/// Fills a buffer; false where nothing is left.
fn read_whole(from: &mut impl BufRead, to: &mut [u8]) -> io::Result<bool> {
    if from.fill_buf()?.is_empty() {
        return Ok(false);
    }
    from.read_exact(to).map(|()| true)
}

/// A picture as `P6`, its width, height and 255, and its bytes.
fn read_ppm(from: &mut BufReader<ChildStdout>) -> io::Result<Option<Image>> {
    if from.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let mut words = [const { String::new() }; 4];
    for word in &mut words {
        // One white byte ends each.
        let mut byte = [0];
        loop {
            from.read_exact(&mut byte)?;
            match byte[0] {
                white if white.is_ascii_whitespace() => break,
                other => word.push(char::from(other)),
            }
        }
    }
    let [kind, width, height, most] = words;
    let (Ok(width), Ok(height)) = (width.parse::<u32>(), height.parse::<u32>()) else {
        return Err(io::Error::other(format!("a picture that begins {kind} {width} {height}")));
    };
    if kind != "P6" || most != "255" || u64::from(width) * u64::from(height) > 1 << 28 {
        return Err(io::Error::other(format!("a picture that begins {kind} {width} {height} {most}")));
    }
    let mut rgb = vec![0; 3 * width as usize * height as usize];
    from.read_exact(&mut rgb)?;
    Ok(Some(Image { width, height, rgb }))
}

/// The variance of the Laplacian of a grey picture: how much of it is edges.
fn laplacian_variance(grey: &[u8], width: usize) -> f64 {
    let height = grey.len() / width;
    let at = |x: usize, y: usize| f64::from(grey[y * width + x]);
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
    fn blur_lowers_the_variance() {
        let picture = |period: usize| -> Vec<u8> {
            (0..32 * 32).map(|i| if ((i % 32) / period).is_multiple_of(2) { 0 } else { 200 }).collect()
        };
        let (fine, coarse) = (laplacian_variance(&picture(1), 32), laplacian_variance(&picture(8), 32));
        assert!(fine > 4.0 * coarse && coarse > 0.0, "{fine} and {coarse}");
        assert_eq!(laplacian_variance(&[7; 64], 8), 0.0);
    }
}
