//! Tests that run in processes of their own: what a process may not survive, or has to itself.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

/// Tells a child process what to work on; without it the tests that are children have nothing to do.
const TARGET: &str = "ZIPSPLAT_TEST_TARGET";

/// The purpose of this process, where it is a child.
pub fn target() -> Option<PathBuf> {
    std::env::var_os(TARGET).map(PathBuf::from)
}

/// Runs the program again with only the test `name`, behind the same loader and below `shell`.
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

/// Runs one test to its end; what it printed.
#[track_caller]
pub fn assert_succeeds(mut command: Command) -> String {
    let out = command.output().expect("bash");
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(out.status.success() && text.contains("1 passed"), "{text}{}", String::from_utf8_lossy(&out.stderr));
    text
}
