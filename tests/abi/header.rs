//! `zipsplat.h` is written by hand: it declares and documents the interface of the sources.

use cbindgen::{Builder, Config, EnumConfig, ExportConfig, Language, RenameRule, Style};
use std::path::{Path, PathBuf};

/// In the header's order. Each uses only types of earlier ones.
const SOURCES: [&str; 18] = [
    "version",
    "status",
    "progress",
    "device",
    "camera",
    "image",
    "capture",
    "scene",
    "edit",
    "model",
    "reconstruction",
    "reconstruct",
    "depth",
    "refine/mod",
    "renderer",
    "gradients",
    "features",
    "vulkan",
];

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the repository is there")
}

/// The lines between its macros and its end.
pub fn header() -> String {
    let text = std::fs::read_to_string(root().join("engine/bindings/c/include/zipsplat.h")).expect("the header");
    let (_, rest) = text.split_once("extern \"C\" {\n#endif\n").expect("the begin of its declarations");
    let (declarations, _) = rest.split_once("#undef ZS_ENUM").expect("the end of its declarations");
    declarations.to_owned()
}

fn exported(source: &str) -> Vec<String> {
    let path = root().join(format!("engine/bindings/c/src/{source}.rs"));
    let text = std::fs::read_to_string(&path).expect("a source");
    let types = ["\npub enum ", "\npub struct ", "\npub type "].into_iter().flat_map(|kind| text.split(kind).skip(1));
    let name = |rest: &str| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next().map(str::to_owned);
    let config = Config {
        language: Language::C,
        no_includes: true,
        documentation: false,
        style: Style::Both,
        usize_is_size_t: true,
        line_length: 120,
        tab_width: 4,
        enumeration: EnumConfig { rename_variants: RenameRule::None, ..EnumConfig::default() },
        export: ExportConfig { include: types.filter_map(name).collect(), ..ExportConfig::default() },
        ..Config::default()
    };
    let mut generated = Vec::new();
    let bindings = Builder::new().with_config(config).with_src(path).generate().expect("a source that parses");
    bindings.write(&mut generated);
    let generated = String::from_utf8(generated).expect("text");
    // Integer fields of an enumeration end in `_value`.
    let generated = generated.replace("_value ", " ").replace("_value;", ";");
    declarations(&generated)
        .into_iter()
        .filter(|declaration| !is_of_enumeration(declaration))
        .map(enumeration)
        .collect()
}

fn is_of_enumeration(declaration: &str) -> bool {
    declaration.starts_with("typedef int32_t") || declaration.starts_with("typedef enum")
}

fn enumeration(declaration: String) -> String {
    match declaration.strip_prefix("enum ").and_then(|rest| rest.split_once("\n  : int32_t\n {")) {
        Some((name, body)) => format!("ZS_ENUM({name}) {{{body}"),
        None => declaration,
    }
}

fn declarations(text: &str) -> Vec<String> {
    let is_code = |line: &&str| !is_comment(line) && (!line.starts_with('#') || line.starts_with("#define"));
    let mut found = vec![String::new()];
    for line in text.lines().filter(|line| !line.is_empty()).filter(is_code) {
        let declaration = found.last_mut().expect("one");
        *declaration += &format!("{line}\n");
        let is_open = declaration.contains('{') && !line.starts_with('}');
        if line.starts_with("#define") || line.ends_with(';') && !is_open {
            found.push(String::new());
        }
    }
    found.retain(|declaration| !declaration.is_empty());
    found
}

fn is_comment(line: &str) -> bool {
    line.trim_start().starts_with("//") || line.starts_with("/*")
}

#[test]
fn declares_what_the_sources_export() {
    let expected: Vec<String> = SOURCES.iter().flat_map(|source| exported(source)).collect();
    let found = declarations(&header());
    let tokens = |text: &String| text.replace("struct ", "").split_whitespace().collect::<Vec<_>>().join(" ");
    let differs = |i: &usize| expected.get(*i).map(tokens) != found.get(*i).map(tokens);
    if let Some(i) = (0..expected.len().max(found.len())).find(differs) {
        let [found, expected] = [found.get(i), expected.get(i)].map(|text| text.map_or("its end\n", String::as_str));
        panic!("zipsplat.h does not follow from engine/bindings/c/src. Found:\n\n{found}\nExpected:\n\n{expected}");
    }
}

/// The header's introduction documents `struct_size` and `reserved`.
#[test]
fn every_declaration_has_a_comment() {
    let header = header();
    let mut is_continued = false;
    let mut before = "";
    for line in header.lines() {
        let is_code = !line.is_empty() && !is_comment(line) && !line.starts_with('}');
        let is_common = line.ends_with(" struct_size;") || line.ends_with(" reserved;");
        let is_documented = is_comment(before) || is_continued || is_common;
        assert!(!is_code || is_documented, "zipsplat.h has no comment above:\n\n{line}\n");
        is_continued = is_code && line.ends_with(',') && !line.contains(" = ");
        before = line;
    }
}
