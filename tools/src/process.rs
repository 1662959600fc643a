//! Other programs, which end with this command's interest in them.

use crate::session::Stage;
use std::{
    ffi::OsStr,
    io::{self, BufRead, BufReader, Read, Write},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::{
        Mutex,
        mpsc::{RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};
use zipsplat::{Error, Result};

/// Between looks at whether a program is done, or this command should stop.
pub const POLL: Duration = Duration::from_millis(10);
/// For a process that no longer reads, or has ended, to be heard.
const LAST_WORDS: Duration = Duration::from_secs(2);

/// The processes that this command runs, for [`end_all`].
static STARTED: Mutex<Vec<u32>> = Mutex::new(Vec::new());

/// A process in a group of its own, ended with all of the group when this is dropped, or when this
/// command is killed.
pub struct Running(pub Child, Option<Child>);

/// Reads a group's number, and ends the group when standard input ends, as it does with this
/// command.
#[cfg(unix)]
const WATCH: &str = "read -r group || exit; read -r _; kill -s KILL -- \"-$group\"";

impl Running {
    /// Starts a program. Ctrl-C in a terminal goes to a whole group: what is started here is ended by this command alone.
    ///
    /// # Errors
    /// The errors of the system.
    pub fn start(command: &mut Command) -> io::Result<Self> {
        set_group(command);
        // Locked while it starts: whoever ends all finds it in the list.
        let mut started = lock(&STARTED);
        // First, so that a kill of this command at any later time ends the program, too.
        let mut watch = watch();
        let child = match command.spawn() {
            Ok(child) => child,
            Err(error) => {
                end_watch(&mut watch);
                return Err(error);
            }
        };
        if let Some(group) = watch.as_mut().and_then(|watch| watch.stdin.as_mut()) {
            // A watcher that has ended cannot watch.
            let _ = writeln!(group, "{}", child.id());
        }
        started.push(child.id());
        Ok(Self(child, watch))
    }

    /// Waits for its end, and looks whether this command should stop.
    ///
    /// # Errors
    /// [`Error::Io`] naming `program`, and [`Error::Cancelled`].
    pub fn wait(&mut self, program: &OsStr, stage: &Stage<'_>) -> Result<ExitStatus> {
        loop {
            if let Some(status) = self.0.try_wait().map_err(|source| Error::io(program, source))? {
                return Ok(status);
            }
            stage.check()?;
            std::thread::sleep(POLL);
        }
    }

    /// Waits a moment for its end, then ends it.
    pub fn end_soon(&mut self) {
        let asked = Instant::now();
        while asked.elapsed() < LAST_WORDS && matches!(self.0.try_wait(), Ok(None)) {
            std::thread::sleep(POLL);
        }
        self.end();
    }

    fn end(&mut self) {
        if matches!(self.0.try_wait(), Ok(None)) {
            end_group(self.0.id());
            // It may have ended meanwhile.
            let _ = self.0.kill();
        }
    }
}

fn set_group(command: &mut Command) {
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
}

/// Starts a shell that ends a group if this command is killed; none on systems without one.
#[cfg(unix)]
fn watch() -> Option<Child> {
    let mut command = Command::new("/bin/sh");
    command.args(["-c", WATCH]).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
    set_group(&mut command);
    command.spawn().ok()
}

#[cfg(not(unix))]
fn watch() -> Option<Child> {
    None
}

fn end_watch(watch: &mut Option<Child>) {
    if let Some(watch) = watch {
        let _ = watch.kill();
        let _ = watch.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
        // First: the number of a child that was waited for may be another's.
        end_watch(&mut self.1);
        lock(&STARTED).retain(|id| *id != self.0.id());
        // A child that is not waited for stays in the system's table.
        let _ = self.0.wait();
    }
}

/// Ends every process that this command runs, with its group, and lets no other start: for a command that ends at once.
pub fn end_all() {
    let started = lock(&STARTED);
    started.iter().for_each(|id| end_group(*id));
    // Never unlocked: the process ends.
    std::mem::forget(started);
}

fn end_group(id: u32) {
    #[cfg(unix)]
    if let Some(group) = i32::try_from(id).ok().and_then(rustix::process::Pid::from_raw) {
        // It may have ended meanwhile.
        let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
    }
}

fn lock(started: &Mutex<Vec<u32>>) -> std::sync::MutexGuard<'_, Vec<u32>> {
    started.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Runs a program to its end and gives every line of its output and errors, as they come, to `line`.
///
/// # Errors
/// [`Error::Io`] naming the program where it cannot be started, the first of `line`, and [`Error::Cancelled`].
pub fn run(command: &mut Command, stage: &Stage<'_>, mut line: impl FnMut(&str) -> Result<()>) -> Result<ExitStatus> {
    let program = command.get_program().to_owned();
    let failed = |source| Error::io(&program, source);
    let (reader, writer) = io::pipe().map_err(failed)?;
    command.stdin(Stdio::null()).stdout(writer.try_clone().map_err(failed)?).stderr(writer);
    let mut running = Running::start(command).map_err(failed)?;
    // The command holds ends of the pipe, which has no end as long as anybody could write to it.
    command.stdout(Stdio::null()).stderr(Stdio::null());
    let (send, lines) = channel();
    std::thread::spawn(move || {
        let mut reader = BufReader::new(reader);
        let mut bytes = Vec::new();
        while reader.read_until(b'\n', &mut bytes).is_ok_and(|count| count > 0) {
            if send.send(String::from_utf8_lossy(&bytes).trim_end().to_owned()).is_err() {
                return;
            }
            bytes.clear();
        }
    });
    let mut ended = None;
    loop {
        stage.check()?;
        match lines.recv_timeout(POLL) {
            Ok(text) => line(&text)?,
            Err(RecvTimeoutError::Disconnected) => break,
            Err(RecvTimeoutError::Timeout) if running.0.try_wait().map_err(failed)?.is_some() => {
                // What it left running may hold the pipe open.
                if ended.get_or_insert_with(Instant::now).elapsed() > LAST_WORDS {
                    break;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
    running.wait(&program, stage)
}

/// Checks that a program runs, asked for its version as ffmpeg is; `name` and `expected` are for the message.
///
/// # Errors
/// [`Error::Argument`] where it does not.
pub fn check(program: &Path, name: &str, expected: &str) -> Result<()> {
    let mut command = Command::new(program);
    command.arg("-version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let reason = match Running::start(&mut command).and_then(|mut running| running.0.wait()) {
        Ok(status) if status.success() => return Ok(()),
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    };
    Err(Error::argument(name, format!("{}: {reason}", program.display()), expected))
}

/// The words that a program prints, output and errors together, where it runs; its exit code is not asked.
///
/// # Errors
/// As [`run`].
pub fn printed(command: &mut Command, stage: &Stage<'_>) -> Result<String> {
    let mut text = String::new();
    run(command, stage, |line| {
        text += line;
        text.push('\n');
        Ok(())
    })?;
    Ok(text)
}

/// The words of a stream to its end, read on the side: a full pipe would stop who writes to it.
pub fn listen(stream: impl Read + Send + 'static) -> std::thread::JoinHandle<String> {
    std::thread::spawn(move || said(stream))
}

fn said(mut stream: impl Read) -> String {
    let mut said = Vec::new();
    // What was said until it broke off is all there is to tell.
    let _ = stream.read_to_end(&mut said);
    String::from_utf8_lossy(&said).into_owned()
}

/// A program's failure in its own words, or by its exit status.
pub fn failure(program: &Path, said: &str, status: impl ToString) -> Error {
    let words = if said.trim().is_empty() { status.to_string() } else { said.trim().to_owned() };
    // Not a broken pipe: that means that nobody reads our own output.
    Error::io(program, io::Error::other(words))
}
