use crate::source::{Source, files};

fn assert_short(sources: &[Source], most: usize) {
    assert!(!sources.is_empty());
    let lines = |source: &Source| source.text.lines().count();
    let long: Vec<String> =
        sources.iter().filter(|s| lines(s) > most).map(|s| format!("{} ({})", s.path, lines(s))).collect();
    assert!(long.is_empty(), "longer than {most} lines: {}", long.join(", "));
}

#[test]
fn rust_files_are_short() {
    for folder in ["engine", "kernels", "tools", "tests"] {
        assert_short(&files(folder, "rs"), 400);
    }
}

#[test]
fn kernels_are_short() {
    assert_short(&files("kernels", "comp"), 200);
    assert_short(&files("kernels", "glsl"), 200);
}
