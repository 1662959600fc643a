use crate::{
    process::{POLL, Running, failure, listen},
    session::Stage,
};
use std::{
    ffi::OsString,
    io::{self, BufRead, BufReader, Read},
    path::Path,
    process::{ChildStdout, Command, Stdio},
    sync::mpsc::{RecvTimeoutError, sync_channel},
};
use zipsplat::{
    Error, Result,
    types::{Image, open_file, write_atomic},
};

/// Output options of ffmpeg for [`read_ppm`].
pub const AS_PPM: [&str; 6] = ["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24"];
/// Excludes playlists, which name other files and addresses.
const CONTAINERS: &str = "mov,matroska,avi,mpegts";
const QUALITY: u8 = 95;
const MOST_LINES: usize = 3;
/// Decoded pictures that wait: large ones fill the memory.
const FRAMES_AHEAD: usize = 2;

/// Decodes ffmpeg's output in a thread with `read` for `take`. Returns warnings.
pub fn decode<T: Send + 'static>(
    ffmpeg: &Path,
    file: &Path,
    options: &[&str],
    stage: &Stage<'_>,
    mut read: impl FnMut(&mut BufReader<ChildStdout>) -> io::Result<Option<T>> + Send + 'static,
    mut take: impl FnMut(T) -> Result<()>,
) -> Result<String> {
    let failed = |source| Error::io(ffmpeg, source);
    let mut command = Command::new(ffmpeg);
    command.args(["-nostdin", "-loglevel", "error"]).args(input(file)).args(options).arg("-");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut running = Running::start(&mut command).map_err(failed)?;
    let messages = running.0.stderr.take().map(listen);
    let Some(stdout) = running.0.stdout.take() else { return Ok(String::new()) };
    let (send, items) = sync_channel(FRAMES_AHEAD);
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
    let messages = words(&messages.and_then(|messages| messages.join().ok()).unwrap_or_default(), file);
    match broken {
        None if status.success() => Ok(messages),
        _ if messages.is_empty() => Err(failure(ffmpeg, "", broken.map_or(status.to_string(), |e| e.to_string()))),
        _ if messages.contains("matches no streams") => {
            Err(Error::format(file, None, "ffmpeg finds no pictures in it"))
        }
        _ => Err(Error::format(file, None, format!("ffmpeg cannot read it: {messages}"))),
    }
}

/// Restricts ffmpeg to this file, without references.
pub fn input(file: &Path) -> impl Iterator<Item = OsString> {
    // A path may look like an option or a protocol.
    let mut name = OsString::from("file:");
    name.push(file);
    let limits = ["-protocol_whitelist", "file,pipe", "-format_whitelist", CONTAINERS, "-i"];
    limits.map(OsString::from).into_iter().chain([name])
}

/// Distinct messages without memory addresses.
fn words(messages: &str, file: &Path) -> String {
    let name = format!("file:{}: ", file.display());
    let mut lines: Vec<&str> = Vec::new();
    for line in messages.lines() {
        let line = line.split_once("] ").filter(|(who, _)| who.starts_with('[')).map_or(line, |(_, line)| line).trim();
        let line = line.strip_prefix(&name).unwrap_or(line);
        if !line.is_empty() && !lines.contains(&line) {
            lines.push(line);
        }
    }
    if lines.len() > MOST_LINES {
        lines.truncate(MOST_LINES);
        lines.push("...");
    }
    lines.join("; ")
}

/// False at the end of the stream.
pub fn read_whole(from: &mut impl BufRead, to: &mut [u8]) -> io::Result<bool> {
    if from.fill_buf()?.is_empty() {
        return Ok(false);
    }
    from.read_exact(to).map(|()| true)
}

/// `P6` of maximum 255; `None` at the end of the stream.
pub fn read_ppm(from: &mut BufReader<ChildStdout>) -> io::Result<Option<Image>> {
    if from.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let mut words = [const { String::new() }; 4];
    for word in &mut words {
        // One whitespace byte ends each field.
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
    Ok(Some(Image { width, height, rgb, mask: None }))
}

pub fn save_jpeg(image: &Image, path: &Path) -> Result<()> {
    let bytes = image.jpeg(QUALITY)?;
    write_atomic(path, |out| out.write_all(&bytes))
}

pub fn exif_of(photo: &Path) -> Option<exif::Exif> {
    exif::Reader::new().read_from_container(&mut BufReader::new(open_file(photo).ok()?)).ok()
}

/// With an EXIF focal length in millimeters for 35 mm film, COLMAP's initial one.
pub fn save_jpeg_of_focal(image: &Image, focal: u16, path: &Path) -> Result<()> {
    let mut bytes = image.jpeg(QUALITY)?;
    let [low, high] = focal.to_le_bytes();
    // Segment, TIFF header, directory with a link to the EXIF directory, which has the one tag.
    let exif = [
        &b"\xff\xe1\x00\x34Exif\0\0II*\0\x08\0\0\0"[..],
        b"\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0",
        b"\x01\0\x05\xa4\x03\0\x01\0\0\0",
        &[low, high, 0, 0, 0, 0, 0, 0],
    ];
    bytes.splice(2..2, exif.concat());
    write_atomic(path, |out| out.write_all(&bytes))
}

#[cfg(test)]
mod tests {
    use super::words;
    use std::path::Path;

    #[test]
    fn words_are_of_the_file_and_few() {
        let messages = "[mov,mp4 @ 0x55] moov atom not found\nfile:a b.mp4: Invalid data\n\n";
        assert_eq!(words(messages, Path::new("a b.mp4")), "moov atom not found; Invalid data");
        let messages = "[h264 @ 0x1] error 1\n[h264 @ 0x2] error 1\nerror 2\nerror 3\nerror 4\n";
        assert_eq!(words(messages, Path::new("a")), "error 1; error 2; error 3; ...");
    }
}
