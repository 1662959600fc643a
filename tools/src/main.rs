//! The `zipsplat` command.

use std::{
    io::{stderr, stdout},
    process::ExitCode,
    sync::atomic::{AtomicBool, Ordering},
};
use zipsplat_cli::{Terminal, run};

static CANCELLED: AtomicBool = AtomicBool::new(false);

fn main() -> ExitCode {
    // Without a handler Ctrl-C still ends the process, only less tidily.
    let _ = ctrlc::set_handler(|| CANCELLED.store(true, Ordering::Relaxed));
    let (mut out, mut err) = (stdout().lock(), stderr());
    let terminal = Terminal { out: &mut out, err: &mut err, progress: true, cancelled: &CANCELLED };
    run(std::env::args_os(), terminal).into()
}
