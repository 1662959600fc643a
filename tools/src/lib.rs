//! The `zipsplat` command as a library, for the command and its tests.

#![allow(missing_docs)]

pub mod align;
mod animation;
mod blocks;
mod cameras;
mod capture;
mod color;
mod commands;
mod decode;
mod depth;
mod download;
mod explain;
mod file_names;
mod heic;
mod html;
mod known_depth;
mod legacy;
mod lifted;
mod masks;
pub mod metrics;
mod npy;
mod options;
mod outputs;
mod panorama;
mod photos;
mod pictures;
mod plot;
pub mod procedural;
mod process;
pub mod protocol;
mod refinement;
mod released;
mod scratch;
mod session;
mod signals;
mod stamp;
mod table;
mod video;
mod viewer;
mod views;

use clap::{CommandFactory, FromArgMatches, Parser};
use commands::Command;
pub use session::Terminal;
use session::{Global, Session};
pub use signals::cancelled_by_signals;
use std::{ffi::OsString, io::ErrorKind};
use zipsplat::Error;

/// Turn photos into a compact scene of 3D Gaussians, refine and render it, on any Vulkan device.
#[derive(Parser)]
#[command(
    name = "zipsplat",
    version,
    after_help = "Examples:
  zipsplat reconstruct photos/ -o scene.ply
  zipsplat reconstruct photos/ --refine -o sharp.ply
  zipsplat render scene.ply --wiggle -o out/
  zipsplat view scene.ply -o scene.html
  zipsplat doctor list
  zipsplat weights get zipsplat
  zipsplat help render

Exit codes:
  0 success   1 failure   2 usage   3 unusable file or argument
  4 no device, device lost or out of memory   5 wrong results found   130 canceled"
)]
struct Cli {
    #[command(flatten)]
    global: Global,
    #[command(subcommand)]
    command: Command,
}

const SHORTEST_CLAUSE: usize = 16;
/// Options in `-h`, besides positional arguments and those of every command.
const SHORT_HELP: [(&str, &[&str]); 10] = [
    (
        "reconstruct",
        &["output", "weights", "cameras", "ratio", "refine", "init", "views", "precision", "each", "dry_run"],
    ),
    (
        "refine",
        &["output", "cameras", "init", "steps", "max_image_size", "max_gaussians", "optimize_cameras", "holdout_views"],
    ),
    (
        "edit",
        &["output", "cameras", "clean", "crop-box", "crop-sphere", "min-opacity", "min-views", "decimate", "sh-degree"],
    ),
    ("cameras", &["output", "method", "weights", "views", "matching", "colmap_model"]),
    ("depth", &["output", "weights", "cameras", "views", "input_size", "metric"]),
    ("render", &["output", "video", "cameras", "orbit", "spline", "size", "frames", "background", "depth"]),
    ("view", &["output", "cameras", "open", "weights", "ratios", "refine"]),
    ("eval", &["output", "views", "targets", "cameras", "pose_free", "refine", "protocol", "scene", "csv"]),
    ("convert", &["spz_version", "dtype", "drop_invalid", "overwrite"]),
    ("doctor", &["only", "report", "verbose"]),
];
fn short_help(command: clap::Command) -> clap::Command {
    let command = command.mut_args(shortened);
    SHORT_HELP.into_iter().fold(command, |command, (name, shown)| {
        command.mut_subcommand(name, |command| {
            let long = command.get_after_help().cloned().unwrap_or_default();
            let command = command.after_help("--help shows all options, and examples.").after_long_help(long);
            command.mut_args(|arg| {
                let hidden = !shown.contains(&arg.get_id().as_str()) && !arg.is_positional();
                shortened(arg).hide_short_help(hidden)
            })
        })
    })
}

/// Cuts help on `-h` to its first clause.
fn shortened(arg: clap::Arg) -> clap::Arg {
    let Some(long) = arg.get_long_help().or(arg.get_help()).map(ToString::to_string) else { return arg };
    let ends = [". ", "; ", ": ", " ["].into_iter().flat_map(|end| long.match_indices(end)).map(|(at, _)| at);
    let count = |at: usize, bracket: char| long[..at].matches(bracket).count();
    let is_whole =
        |at: &usize| *at > SHORTEST_CLAUSE && count(*at, '(') <= count(*at, ')') && count(*at, '[') <= count(*at, ']');
    let end = ends.filter(is_whole).min().unwrap_or(long.len());
    arg.help(long[..end].to_owned()).long_help(long)
}

/// Returns the exit code (see `--help`). `args` start with the program name.
pub fn run(args: impl IntoIterator<Item = OsString>, terminal: Terminal<'_>) -> u8 {
    let commands = Cli::command();
    let is_command = |word: &str| {
        commands.get_subcommands().any(|verb| verb.get_name() == word || verb.find_subcommand(word).is_some())
    };
    let args = legacy::rewritten(refinement::join_steps(args), is_command);
    let parsed = short_help(Cli::command()).try_get_matches_from(&args);
    let parsed =
        parsed.and_then(|found| Ok((found.subcommand_name().map(str::to_owned), Cli::from_arg_matches(&found)?)));
    let (name, Cli { global, command }) = match parsed {
        Ok(parsed) => parsed,
        Err(error) => {
            let (stream, code) =
                (if error.use_stderr() { terminal.err } else { terminal.out }, error.exit_code() as u8);
            let mut text = error.to_string();
            if code != 0 && args.iter().take_while(|arg| *arg != "--").any(|arg| arg == "--json") {
                text = session::error_as_json(text.trim_start_matches("error: ").trim_end(), "usage", code) + "\n";
            }
            // The stream may be closed.
            let _ = stream.write_all(text.as_bytes());
            return code;
        }
    };
    let mut session = Session::new(name.unwrap_or_default(), global, terminal);
    match command.run(&mut session) {
        Ok(()) => session.code,
        Err(error) => {
            let (kind, code) = class(&error);
            if code != 0 {
                session.complain(&error, kind, code);
            }
            code
        }
    }
}

/// 128 plus SIGINT.
const CANCELLED: u8 = 130;

/// Kind of an error, as in --json, and its exit code.
fn class(error: &Error) -> (&'static str, u8) {
    match error {
        Error::Argument { .. } => ("argument", 3),
        Error::Format { .. } => ("format", 3),
        Error::Weights { .. } => ("weights", 3),
        Error::Io { source, .. } => match source.kind() {
            // The reader of our output is done.
            ErrorKind::BrokenPipe => ("io", 0),
            ErrorKind::NotFound
            | ErrorKind::PermissionDenied
            | ErrorKind::NotADirectory
            | ErrorKind::IsADirectory
            | ErrorKind::InvalidInput
            | ErrorKind::InvalidFilename => ("io", 3),
            _ => ("io", 1),
        },
        Error::NoDevice(_) => ("no_device", 4),
        Error::DeviceLost => ("device_lost", 4),
        Error::Memory { .. } => ("memory", 4),
        Error::Cancelled => ("cancelled", CANCELLED),
        Error::Driver { .. } => ("driver", 1),
        _ => ("internal", 1),
    }
}
