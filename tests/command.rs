use std::sync::atomic::AtomicBool;
use zipsplat_cli::{Terminal, run};

/// Returns exit code, standard output and errors.
pub fn zipsplat(line: &str) -> (u8, Vec<u8>, String) {
    let args = std::iter::once("zipsplat").chain(line.split_whitespace()).map(Into::into);
    let (mut out, mut err, cancelled) = (Vec::new(), Vec::new(), AtomicBool::new(false));
    let code = run(args, Terminal { out: &mut out, err: &mut err, progress: false, cancelled: &cancelled });
    (code, out, String::from_utf8(err).expect("errors are text"))
}
