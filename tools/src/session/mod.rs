mod progress;

pub use progress::Stage;

use crate::table::bytes;
use clap::Args;
use serde::Serialize;
use std::{
    fmt::Display,
    io::Write,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc::channel,
    },
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    gpu::{Device, DeviceOptions, Limits, Progress},
    ops::{Arithmetic, Precision},
    reconstruct::{Block, Model, ReconstructOptions, Reconstruction, SceneTokens},
    tune::KernelChoice,
    types::Image,
    weights::Checkpoint,
};

const POLL: Duration = Duration::from_millis(50);
const NO_DEVICE: &str = "none";
/// Version of the --json output.
const SCHEMA_VERSION: u32 = 1;

pub struct Terminal<'a> {
    pub out: &'a mut dyn Write,
    pub err: &'a mut dyn Write,
    /// Progress on standard error: a bar on a terminal, else occasional lines.
    pub progress: bool,
    /// Stop flag: the command ends with exit code 130 and leaves no partial file.
    pub cancelled: &'a AtomicBool,
}

#[derive(Args)]
pub struct Global {
    /// Vulkan device: number in `zipsplat doctor list`, UUID, or part of the name that is not all
    /// digits; none: plan for a typical GPU, with `--dry-run` [default: the best]
    #[arg(long, global = true, value_name = "NAME|INDEX", help_heading = "Options of every command")]
    pub device: Option<String>,
    /// Device memory limit in bytes, such as 3G, also of photos kept in host memory by a
    /// refinement; K, M and G are powers of 1024 [default: all, 4G of photos]
    #[arg(long, alias = "memory", global = true, value_name = "BYTES", value_parser = parse_bytes, help_heading = "Options of every command")]
    pub max_memory: Option<u64>,
    /// Print the result as JSON to standard output: {"schema_version", "command", "warnings",
    /// "result"}; an error as one line of JSON to standard error: {"error", "kind", "exit_code"}
    #[arg(long, global = true, help_heading = "Options of every command")]
    pub json: bool,
    /// Print errors only: no result, notes or progress; --json still prints
    #[arg(long, short, global = true, help_heading = "Options of every command")]
    pub quiet: bool,
}

#[derive(Serialize)]
struct Envelope<'a, T> {
    schema_version: u32,
    command: &'a str,
    warnings: &'a [String],
    result: T,
}

pub struct Session<'a> {
    command: String,
    warnings: Vec<String>,
    global: Global,
    terminal: Terminal<'a>,
    piped: bool,
    /// Exit code of a command without an error.
    pub code: u8,
    /// Start of the stages' names.
    pub task: String,
    pub began: Instant,
    next_line: Mutex<Instant>,
}

impl<'a> Session<'a> {
    pub fn new(command: String, global: Global, terminal: Terminal<'a>) -> Self {
        let began = Instant::now();
        let next_line = Mutex::new(began + progress::FIRST_LINE);
        Self {
            command,
            warnings: Vec::new(),
            global,
            terminal,
            piped: false,
            code: 0,
            task: String::new(),
            began,
            next_line,
        }
    }

    pub fn device(&mut self) -> Result<Device> {
        let device = Device::open(&self.device_options())?;
        device.passed_over().iter().for_each(|why| self.note(format_args!("{why}: a CPU is used")));
        Ok(device)
    }

    pub fn device_options(&self) -> DeviceOptions {
        let Global { device, max_memory, .. } = &self.global;
        DeviceOptions { device: device.clone(), max_memory_bytes: *max_memory, ..DeviceOptions::default() }
    }

    pub fn plans_for_none(&self) -> bool {
        self.global.device.as_deref() == Some(NO_DEVICE)
    }

    /// Returns the device to plan for, or none for an ordinary one.
    pub fn planned_device(&mut self) -> Result<Option<Device>> {
        if self.plans_for_none() {
            return Ok(None);
        }
        match self.device() {
            Err(Error::NoDevice(why)) if self.global.device.is_none() => {
                self.note(format!("planned for an ordinary device: {why}"));
                Ok(None)
            }
            found => found.map(Some),
        }
    }

    /// Notes a planned peak above the memory of the device or `--max-memory`.
    pub fn note_excess(&mut self, peak: u64, limits: &Limits) {
        if peak > limits.memory_bytes {
            let (peak, limit) = (bytes(peak), bytes(limits.memory_bytes));
            self.note(format_args!("a run would be refused: it takes {peak} of memory, allowed are {limit}"));
        }
    }

    /// Limits of an ordinary device, and `--max-memory`.
    pub fn ordinary_limits(&self) -> Limits {
        let limits = Limits::default();
        Limits { memory_bytes: self.global.max_memory.unwrap_or(limits.memory_bytes), ..limits }
    }

    /// Also returns its time.
    pub fn stage<T>(&self, name: &str, body: impl FnOnce(&Stage<'_>) -> Result<T>) -> Result<(T, Duration)> {
        let stage = Stage::new(name, &self.task, self.terminal.cancelled);
        stage.check()?;
        let start = Instant::now();
        let result = if self.terminal.progress && !self.global.quiet {
            stage.shown(&self.next_line, body)
        } else {
            body(&stage)
        };
        let value = result?;
        stage.check()?;
        Ok((value, start.elapsed()))
    }

    /// Self-tests the kernels on the first use of a precision on a device, and notes failed ones.
    pub fn choose(&mut self, device: &Device, precision: Option<Precision>) -> Result<(Precision, Arithmetic)> {
        let (chosen, _) = self.stage("first use", |stage| {
            KernelChoice::of_with(device, precision, |kernel, done| {
                stage.name(&format!("first use: testing {kernel}"));
                stage.at(done)
            })
        })?;
        self.notes(&chosen.warnings);
        Ok((chosen.precision, chosen.arithmetic))
    }

    pub fn load_model(
        &self,
        device: &Device,
        checkpoint: &Checkpoint,
        arithmetic: Arithmetic,
    ) -> Result<(Model, Duration)> {
        self.stage("load weights", |stage| {
            Model::from_checkpoint_with(device, checkpoint, arithmetic, |done| stage.at(done))
        })
    }

    /// Runs the backbone once per block of views for a scene and any requested tokens.
    pub fn reconstruct(
        &self,
        model: &Model,
        images: &[Image],
        blocks: &[Block],
        request: &ReconstructOptions,
        tokens: bool,
    ) -> Result<((Reconstruction, Option<SceneTokens>), Duration)> {
        self.stage("reconstruct", |stage| {
            let follow = |progress: Progress<'_>| stage.follow(progress);
            if !tokens {
                return Ok((model.reconstruct_blocks(images, request, blocks, follow)?, None));
            }
            refuse_tokens(blocks.len())?;
            let features = model.features(images, request, follow)?;
            let mut made = model.reconstruct_features(&features, request, follow)?;
            let tokens = model.tokens(&features, request, follow)?;
            made.times.0.splice(0..0, features.times.0);
            Ok((made, Some(tokens)))
        })
    }

    pub fn report(&mut self, value: &impl Serialize, text: impl Display) -> Result<()> {
        let (out, name) = if self.piped {
            (&mut *self.terminal.err, "standard error")
        } else {
            (&mut *self.terminal.out, "standard output")
        };
        let Self { command, warnings, .. } = self;
        let envelope = Envelope { schema_version: SCHEMA_VERSION, command, warnings, result: value };
        let printed = match (self.global.json, self.global.quiet) {
            (true, _) => serde_json::to_writer_pretty(&mut *out, &envelope)
                .map_err(std::io::Error::from)
                .and_then(|()| writeln!(out)),
            (false, false) => writeln!(out, "{}", text.to_string().trim_end()),
            (false, true) => Ok(()),
        };
        printed.and_then(|()| out.flush()).map_err(|error| Error::io(name, error))
    }

    /// Takes standard output for data; the result then goes to standard error.
    pub fn take_output(&mut self) -> &'a mut dyn Write {
        self.piped = true;
        std::mem::replace(&mut self.terminal.out, Box::leak(Box::new(std::io::sink())))
    }

    pub fn cancelled(&self) -> &'a AtomicBool {
        self.terminal.cancelled
    }

    pub fn note(&mut self, text: impl Display) {
        let text = text.to_string();
        if !self.global.quiet {
            let _ = writeln!(self.terminal.err, "note: {text}");
        }
        self.warnings.push(text);
    }

    pub fn notes<T: Display>(&mut self, texts: impl IntoIterator<Item = T>) {
        texts.into_iter().for_each(|text| self.note(text));
    }

    pub fn ask(&mut self, question: &str) -> Result<String> {
        let asked = write!(self.terminal.err, "{question}").and_then(|()| self.terminal.err.flush());
        asked.map_err(|error| Error::io("standard error", error))?;
        let (send, answer) = channel();
        // Signals do not interrupt a read: cancellation abandons its thread.
        std::thread::spawn(move || {
            let mut line = String::new();
            let _ = send.send(std::io::stdin().read_line(&mut line).map(|_| line));
        });
        loop {
            match answer.recv_timeout(POLL) {
                Ok(line) => return line.map_err(|error| Error::io("standard input", error)),
                Err(_) if self.terminal.cancelled.load(Ordering::Relaxed) => return Err(Error::Cancelled),
                Err(_) => {}
            }
        }
    }

    pub fn complain(&mut self, error: &Error, kind: &str, code: u8) {
        let mut lines: Vec<_> = error.to_string().lines().map(|line| line.trim().to_owned()).collect();
        if let Error::Memory { needed, available, .. } = error {
            lines.push(format!("{} of device memory are missing", bytes(needed.saturating_sub(*available))));
            let limit = self.global.max_memory;
            lines.extend(limit.map(|limit| format!("--max-memory allows {} of the device's memory", bytes(limit))));
        }
        let text = lines.join("; ");
        let line = if self.global.json { error_as_json(&text, kind, code) } else { format!("error: {text}") };
        let _ = writeln!(self.terminal.err, "{line}");
    }
}

/// Rejects token refinement, which takes one pass.
pub fn refuse_tokens(blocks: usize) -> Result<()> {
    let found = format!("{blocks} blocks of views");
    if blocks > 1 { Err(Error::argument("--refine-target tokens", found, "views that fit in one")) } else { Ok(()) }
}

pub fn stage_seconds(times: &[(impl ToString, Duration)]) -> serde_json::Value {
    times.iter().map(|(stage, took)| (stage.to_string(), serde_json::json!(took.as_secs_f64()))).collect()
}

pub fn error_as_json(text: &str, kind: &str, code: u8) -> String {
    serde_json::json!({ "error": text, "kind": kind, "exit_code": code }).to_string()
}

fn parse_bytes(text: &str) -> Result<u64, String> {
    let (number, unit) = match text.strip_suffix(['K', 'M', 'G']) {
        Some(number) if text.ends_with('K') => (number, 1 << 10),
        Some(number) if text.ends_with('M') => (number, 1 << 20),
        Some(number) => (number, 1 << 30),
        None => (text, 1),
    };
    let bytes = number.parse().ok().and_then(|number: u64| number.checked_mul(unit));
    bytes.ok_or_else(|| "expected a number of bytes, such as 800000000, 800M or 3G".into())
}
