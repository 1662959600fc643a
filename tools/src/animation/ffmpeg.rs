use super::Encoder;
use crate::{
    process::{Running, failure, listen},
    session::Stage,
};
use std::{
    ffi::OsString,
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread::JoinHandle,
};
use zipsplat::{
    Error, Result,
    types::{Image, Unfinished},
};

/// Widely supported; chroma subsampling needs even sides.
const ENCODING: &str = "-vf crop=trunc(iw/2)*2:trunc(ih/2)*2 -c:v libx264 -crf 18 -pix_fmt yuv420p -movflags +faststart \
                        -metadata comment=zipsplat -f mp4";

pub struct Ffmpeg {
    program: PathBuf,
    child: Running,
    /// A full pipe would block ffmpeg.
    messages: Option<JoinHandle<String>>,
    // Dropped after the child, which still writes to it.
    file: Unfinished,
}

impl Ffmpeg {
    pub fn begin(program: &Path, path: &Path, (width, height): (u32, u32), fps: u16) -> Result<Self> {
        let file = Unfinished::begin(path)?;
        let mut command = Command::new(program);
        command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{width}x{height}"), "-framerate", &fps.to_string(), "-i", "-"]);
        // A path may look like an option or a protocol.
        let mut out = OsString::from("file:");
        out.push(file.temporary_path());
        command.args(ENCODING.split_whitespace()).arg(out);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = Running::start(&mut command).map_err(|source| Error::io(program, source))?;
        let messages = child.0.stderr.take().map(listen);
        Ok(Self { program: program.into(), child, messages, file })
    }

    fn failure(&mut self, reason: String) -> Error {
        let messages = self.messages.take().and_then(|messages| messages.join().ok()).unwrap_or_default();
        failure(&self.program, &messages, reason)
    }
}

impl Encoder for Ffmpeg {
    fn push(&mut self, images: &[Image]) -> Result<()> {
        let Some(stdin) = &mut self.child.0.stdin else { return Ok(()) };
        let written = images.iter().try_for_each(|image| stdin.write_all(&image.rgb));
        written.map_err(|error| {
            let reason = match error.kind() {
                ErrorKind::BrokenPipe => "ended before it had all pictures".into(),
                _ => error.to_string(),
            };
            self.child.end_soon();
            self.failure(reason)
        })
    }

    fn finish(mut self: Box<Self>, stage: &Stage<'_>) -> Result<()> {
        drop(self.child.0.stdin.take());
        let status = self.child.wait(self.program.as_os_str(), stage)?;
        if !status.success() {
            return Err(self.failure(status.to_string()));
        }
        let Self { file, .. } = *self;
        file.finish()
    }
}
