use std::sync::atomic::AtomicBool;
use zipsplat_cli::Terminal;

/// Returns exit code, standard output and errors.
pub fn run(line: &str, cancelled: &AtomicBool) -> (u8, Vec<u8>, String) {
    let args = std::iter::once("zipsplat").chain(line.split_whitespace()).map(Into::into);
    let (mut out, mut err) = (Vec::new(), Vec::new());
    let code = zipsplat_cli::run(args, Terminal { out: &mut out, err: &mut err, progress: false, cancelled });
    (code, out, String::from_utf8(err).expect("errors are text"))
}

/// [`run`] to its end.
pub fn zipsplat(line: &str) -> (u8, Vec<u8>, String) {
    run(line, &AtomicBool::new(false))
}
