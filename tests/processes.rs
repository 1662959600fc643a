//! Tests in child processes: some kill the process, others need it alone.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

const TARGET: &str = "ZIPSPLAT_TEST_TARGET";

pub fn target() -> Option<PathBuf> {
    std::env::var_os(TARGET).map(PathBuf::from)
}

/// Reruns this program with the test `name`, through the same loader and `shell`.
pub fn child(name: &str, target: &Path, shell: &str) -> Command {
    let line = std::fs::read("/proc/self/cmdline").expect("Linux");
    let words: Vec<String> =
        line.split(|byte| *byte == 0).map(|word| String::from_utf8_lossy(word).into_owned()).collect();
    let program = std::env::args().next().expect("a program");
    let place = words.iter().position(|word| *word == program).expect("the program is on its own command line");
    let mut command = Command::new("bash");
    command.args(["-c", &format!("{shell}\nexec \"$@\""), "bash"]).args(&words[..=place]);
    command.args(["--exact", name, "--ignored", "--test-threads=1"]);
    command.env(TARGET, target).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

pub fn resident_bytes() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").expect("Linux");
    4096 * pages.split(' ').nth(1).and_then(|count| count.parse::<u64>().ok()).expect("a number of pages")
}

/// `python3` may lack NumPy.
pub fn python_with_numpy() -> PathBuf {
    let found = ["python3", "/usr/bin/python3"].iter().find_map(|name| {
        let found = Command::new(name).args(["-c", "import sys, numpy; print(sys.executable)"]).output().ok()?;
        let path = String::from_utf8(found.stdout).ok()?.trim().to_owned();
        (found.status.success() && !path.is_empty()).then(|| path.into())
    });
    found.expect("a python3 with NumPy; tools/test.sh installs one")
}

#[track_caller]
pub fn assert_succeeds(mut command: Command) -> String {
    let out = command.output().expect("bash");
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(out.status.success() && text.contains("1 passed"), "{text}{}", String::from_utf8_lossy(&out.stderr));
    text
}
