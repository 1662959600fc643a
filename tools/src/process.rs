//! Child processes that end with this command.

use crate::session::Stage;
use std::{
    ffi::OsStr,
    io::{self, BufRead, BufReader, Read, Write},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::{
        Mutex, MutexGuard, PoisonError,
        mpsc::{RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};
use zipsplat::{Error, Result};

pub const POLL: Duration = Duration::from_millis(10);
/// Timeout for the last output of an ended process.
const LAST_WORDS: Duration = Duration::from_secs(2);

static STARTED: Mutex<Vec<u32>> = Mutex::new(Vec::new());

/// Process in its own group, which ends on drop or with this command.
pub struct Running(pub Child, Option<Child>);

/// Kills a group when standard input closes, with this command.
#[cfg(unix)]
const WATCH: &str = "read -r group || exit; read -r _; kill -s KILL -- \"-$group\"";

impl Running {
    /// Only this command receives Ctrl-C: the program has its own group.
    pub fn start(command: &mut Command) -> io::Result<Self> {
        set_group(command);
        let mut started = lock(&STARTED);
        // Before the program, so that a kill of this command ends it.
        let mut watch = watch();
        let child = match command.spawn() {
            Ok(child) => child,
            Err(error) => {
                end_watch(&mut watch);
                return Err(error);
            }
        };
        if let Some(group) = watch.as_mut().and_then(|watch| watch.stdin.as_mut()) {
            let _ = writeln!(group, "{}", child.id());
        }
        started.push(child.id());
        Ok(Self(child, watch))
    }

    pub fn wait(&mut self, program: &OsStr, stage: &Stage<'_>) -> Result<ExitStatus> {
        loop {
            if let Some(status) = self.0.try_wait().map_err(|source| Error::io(program, source))? {
                return Ok(status);
            }
            stage.check()?;
            std::thread::sleep(POLL);
        }
    }

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
            let _ = self.0.kill();
        }
    }
}

fn set_group(command: &mut Command) {
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
}

/// A shell that ends a group if this command is killed.
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
        // After `wait` the number may belong to another process.
        end_watch(&mut self.1);
        lock(&STARTED).retain(|id| *id != self.0.id());
        let _ = self.0.wait();
    }
}

pub fn end_all() {
    let started = lock(&STARTED);
    started.iter().for_each(|id| end_group(*id));
    // Stays locked until the exit.
    std::mem::forget(started);
}

fn end_group(id: u32) {
    #[cfg(unix)]
    if let Some(group) = i32::try_from(id).ok().and_then(rustix::process::Pid::from_raw) {
        let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
    }
}

/// Locks values that stay complete across a panic.
pub fn lock<T>(values: &Mutex<T>) -> MutexGuard<'_, T> {
    values.lock().unwrap_or_else(PoisonError::into_inner)
}

pub fn run(command: &mut Command, stage: &Stage<'_>, mut line: impl FnMut(&str) -> Result<()>) -> Result<ExitStatus> {
    let program = command.get_program().to_owned();
    let failed = |source| Error::io(&program, source);
    let (reader, writer) = io::pipe().map_err(failed)?;
    command.stdin(Stdio::null()).stdout(writer.try_clone().map_err(failed)?).stderr(writer);
    let mut running = Running::start(command).map_err(failed)?;
    // Drops our pipe ends, so that the reader sees the end.
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
                // A surviving grandchild may hold the pipe open.
                if ended.get_or_insert_with(Instant::now).elapsed() > LAST_WORDS {
                    break;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
    running.wait(&program, stage)
}

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

/// Accepts any exit code.
pub fn printed(command: &mut Command, stage: &Stage<'_>) -> Result<String> {
    let mut text = String::new();
    run(command, stage, |line| {
        text += line;
        text.push('\n');
        Ok(())
    })?;
    Ok(text)
}

/// In a thread: a full pipe would block the writer.
pub fn listen(mut stream: impl Read + Send + 'static) -> std::thread::JoinHandle<String> {
    std::thread::spawn(move || {
        let mut text = Vec::new();
        let _ = stream.read_to_end(&mut text);
        String::from_utf8_lossy(&text).into_owned()
    })
}

pub fn failure(program: &Path, message: &str, status: impl ToString) -> Error {
    let words = if message.trim().is_empty() { status.to_string() } else { message.trim().to_owned() };
    // A broken pipe means our own output.
    Error::io(program, io::Error::other(words))
}
