//! The `zipsplat` command.

use std::{
    io::{stderr, stdout},
    process::ExitCode,
};
use zipsplat_cli::{Terminal, cancelled_by_signals, run};

fn main() -> ExitCode {
    let cancelled = cancelled_by_signals();
    let (mut out, mut err) = (stdout().lock(), stderr());
    let terminal = Terminal { out: &mut out, err: &mut err, progress: true, cancelled };
    run(std::env::args_os(), terminal).into()
}
