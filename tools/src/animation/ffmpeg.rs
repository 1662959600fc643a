//! MP4 by an installed ffmpeg, which gets the pictures through a pipe.

use super::Encoder;
use crate::session::Stage;
use std::{
    ffi::OsString,
    io::{ErrorKind, Read, Write},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread::JoinHandle,
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    types::{Image, Unfinished},
};

/// H.264 as every player has it: half as many colour samples a side, for which sides have to be even.
const ENCODING: &str = "-vf crop=trunc(iw/2)*2:trunc(ih/2)*2 -c:v libx264 -crf 18 -pix_fmt yuv420p -movflags +faststart \
                        -metadata comment=zipsplat -f mp4";
/// Between looks at whether ffmpeg is done.
const POLL: Duration = Duration::from_millis(10);
/// For a process that no longer reads to say why.
const LAST_WORDS: Duration = Duration::from_secs(2);

pub struct Ffmpeg {
    program: PathBuf,
    child: Running,
    /// What it says, read on the side: a full pipe would stop it.
    said: Option<JoinHandle<String>>,
    // After the child: the file is removed when nobody writes to it any more.
    file: Unfinished,
}

/// A process that ends with this command's interest in it.
struct Running(Child);

/// Whether ffmpeg runs.
///
/// # Errors
/// [`Error::Argument`] where it does not.
pub fn check(program: &Path) -> Result<()> {
    let mut command = Command::new(program);
    command.arg("-version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let reason = match command.status() {
        Ok(status) if status.success() => return Ok(()),
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    };
    let expected = "an installed ffmpeg for MP4 (see --ffmpeg); .gif and .apng need none";
    Err(Error::argument("ffmpeg", format!("{}: {reason}", program.display()), expected))
}

impl Ffmpeg {
    pub fn begin(program: &Path, path: &Path, (width, height): (u32, u32), fps: u16) -> Result<Self> {
        let file = Unfinished::begin(path)?;
        let mut command = Command::new(program);
        command.args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
        command.args(["-s", &format!("{width}x{height}"), "-framerate", &fps.to_string(), "-i", "-"]);
        // Named as a file: a path may look like an option or a protocol.
        let mut out = OsString::from("file:");
        out.push(file.temporary_path());
        command.args(ENCODING.split_whitespace()).arg(out);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        // Ctrl-C in a terminal goes to a whole group; this command ends ffmpeg itself.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn().map_err(|source| Error::io(program, source))?;
        let said = child.stderr.take().map(|mut stderr| {
            std::thread::spawn(move || {
                let mut said = Vec::new();
                // What was said until it broke off is all there is to tell.
                let _ = stderr.read_to_end(&mut said);
                String::from_utf8_lossy(&said).into_owned()
            })
        });
        Ok(Self { program: program.into(), child: Running(child), said, file })
    }

    /// Ffmpeg's own words, or the reason given.
    fn failure(&mut self, reason: String) -> Error {
        let said = self.said.take().and_then(|said| said.join().ok()).unwrap_or_default();
        let words = if said.trim().is_empty() { reason } else { said.trim().to_owned() };
        // Not a broken pipe: that means that nobody reads our own output.
        Error::io(&self.program, std::io::Error::other(words))
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
            // What it has to say ends when it does.
            self.child.end_soon();
            self.failure(reason)
        })
    }

    fn finish(mut self: Box<Self>, stage: &Stage<'_>) -> Result<()> {
        drop(self.child.0.stdin.take());
        let status = loop {
            match self.child.0.try_wait().map_err(|source| Error::io(&self.program, source))? {
                Some(status) => break status,
                None => stage.reach(1.0)?,
            }
            std::thread::sleep(POLL);
        };
        if !status.success() {
            return Err(self.failure(status.to_string()));
        }
        let Self { file, .. } = *self;
        file.finish()
    }
}

impl Running {
    /// Waits a moment for its end, then ends it.
    fn end_soon(&mut self) {
        let asked = Instant::now();
        while asked.elapsed() < LAST_WORDS && matches!(self.0.try_wait(), Ok(None)) {
            std::thread::sleep(POLL);
        }
        // It may have ended already.
        let _ = self.0.kill();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already; a child that is not waited for stays in the system's table.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
