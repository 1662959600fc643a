use std::fs;
use std::path::Path;

#[derive(Clone)]
pub struct Source {
    /// Below the repository's root, with slashes.
    pub path: String,
    pub text: String,
}

pub fn files(folder: &str, ext: &str) -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut found = Vec::new();
    walk(&root, folder, &format!(".{ext}"), &mut found);
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

fn walk(root: &Path, folder: &str, ending: &str, found: &mut Vec<Source>) {
    let entries = fs::read_dir(root.join(folder)).unwrap_or_else(|error| panic!("{folder}: {error}"));
    for entry in entries.map(|entry| entry.expect("a readable folder")) {
        let path = format!("{folder}/{}", entry.file_name().to_string_lossy());
        if entry.path().is_dir() {
            walk(root, &path, ending, found);
        } else if path.ends_with(ending) {
            let text = fs::read_to_string(entry.path()).unwrap_or_else(|error| panic!("{path}: {error}"));
            found.push(Source { path, text });
        }
    }
}

/// Skips comments, strings and whitespace.
pub fn tokens(text: &str) -> Vec<String> {
    let mut tokens = Vec::new();
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("'\"'") || rest.starts_with("'\\\"'") {
            rest[1..].find("'").expect("it closes") + 2
        } else if first == '"' {
            string_length(rest)
        } else {
            let word = |c: char| c.is_alphanumeric() || c == '_';
            let length = match first {
                ':' if rest.starts_with("::") => 2,
                c if word(c) => rest.find(|c| !word(c)).unwrap_or(rest.len()),
                c => c.len_utf8(),
            };
            if !first.is_whitespace() {
                tokens.push(rest[..length].to_owned());
            }
            length
        };
        rest = &rest[length..];
    }
    tokens
}

/// Raw strings here contain no quotes.
fn string_length(text: &str) -> usize {
    let mut escaped = false;
    for (i, c) in text.char_indices().skip(1) {
        match c {
            '"' if !escaped => return i + 1,
            _ => escaped = c == '\\' && !escaped,
        }
    }
    text.len()
}

/// `crate::{a::B, c::*}` gives `crate::a::B` and `crate::c`.
pub fn paths(tokens: &[String], roots: &[&str]) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        let starts = roots.contains(&tokens[at].as_str()) && tokens.get(at + 1).is_some_and(|next| next == "::");
        if starts && (at == 0 || tokens[at - 1] != "::") {
            at = path(tokens, at, Vec::new(), &mut found);
        } else {
            at += 1;
        }
    }
    found
}

fn path(tokens: &[String], mut at: usize, mut prefix: Vec<String>, found: &mut Vec<Vec<String>>) -> usize {
    loop {
        match tokens[at].as_str() {
            "{" => {
                at += 1;
                while tokens[at] != "}" {
                    at = if tokens[at] == "," { at + 1 } else { path(tokens, at, prefix.clone(), found) };
                }
                return at + 1;
            }
            word if word.starts_with(|c: char| c.is_alphanumeric() || c == '_') => prefix.push(word.to_owned()),
            _ => {
                found.push(prefix);
                return at + 1;
            }
        }
        at += 1;
        match tokens.get(at).map(String::as_str) {
            Some("::") => at += 1,
            Some("as") => {
                found.push(prefix);
                return at + 2;
            }
            _ => {
                found.push(prefix);
                return at;
            }
        }
    }
}

#[test]
fn comments_and_strings_are_no_code() {
    let code = "a::b(\"unsafe \\\" vk::x\", '\"', 'c') // unsafe\n/// vk::\n + r\"unsafe\"";
    assert_eq!(tokens(code).join(" "), "a :: b ( , , ' c ' ) + r");
}

#[test]
fn groups_are_taken_apart() {
    let code = "use crate::{gpu::{Device, Tensor as T}, ops::*}; fn f() { super::g::<u8>(crate::Error) } pub(crate) x";
    let found: Vec<String> = paths(&tokens(code), &["crate", "super"]).iter().map(|path| path.join("::")).collect();
    assert_eq!(found, ["crate::gpu::Device", "crate::gpu::Tensor", "crate::ops", "super::g", "crate::Error"]);
}
