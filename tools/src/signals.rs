use crate::{CANCELLED, process};
use std::sync::atomic::{AtomicBool, Ordering};

/// Flag for [`Terminal::cancelled`](crate::Terminal), set by SIGINT, SIGTERM or SIGHUP. A second
/// signal ends the process and its children at once, without cleanup.
pub fn cancelled_by_signals() -> &'static AtomicBool {
    static STOP: AtomicBool = AtomicBool::new(false);
    if !outlives_terminal() {
        // Without a handler, signals end the process without cleanup.
        let _ = ctrlc::set_handler(|| {
            if STOP.swap(true, Ordering::Relaxed) {
                process::end_all();
                std::process::exit(CANCELLED.into());
            }
        });
    }
    &STOP
}

/// Detects an ignored SIGHUP, as under nohup; a handler would undo that.
fn outlives_terminal() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    ignored.is_some_and(|mask| mask & 1 == 1)
}
