//! The committed header is cbindgen's, grouped by source file.

use cbindgen::{Builder, Config, DocumentationStyle, EnumConfig, ExportConfig, Language, RenameRule, Style};
use std::path::{Path, PathBuf};

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
    "refine",
    "renderer",
    "gradients",
    "features",
    "vulkan",
];

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the repository is there")
}

/// Enumerations that structures store as integers, each with an alias of its name and `_value`.
pub fn enumerations() -> Vec<String> {
    let aliased = |line: &str| {
        let name = line.strip_prefix("pub(super) type ")?.strip_suffix("_value = i32;")?;
        Some(name.to_owned())
    };
    SOURCES.map(text).iter().flat_map(|source| source.lines().filter_map(aliased)).collect()
}

fn generate() -> String {
    let preamble = std::fs::read_to_string(sources().join("preamble.h")).expect("a preamble");
    let enumerations = enumerations();
    let number = |name: &String| format!("{name}_value");
    let config = Config {
        language: Language::C,
        header: Some(preamble.trim_end().to_owned()),
        include_guard: Some("ZIPSPLAT_H".into()),
        no_includes: true,
        sys_includes: vec!["stddef.h".into(), "stdint.h".into()],
        cpp_compat: true,
        style: Style::Both,
        documentation_style: DocumentationStyle::C99,
        usize_is_size_t: true,
        line_length: 120,
        tab_width: 4,
        enumeration: EnumConfig { rename_variants: RenameRule::None, ..EnumConfig::default() },
        export: ExportConfig {
            exclude: enumerations.iter().map(number).collect(),
            rename: enumerations.iter().map(|name| (number(name), name.clone())).collect(),
            include: enumerations,
            ..ExportConfig::default()
        },
        ..Config::default()
    };
    let builder = SOURCES.iter().fold(Builder::new().with_config(config), |builder, name| {
        builder.with_src(sources().join(format!("{name}.rs")))
    });
    let mut header = Vec::new();
    builder.generate().expect("the sources can be read").write(&mut header);
    by_source(&String::from_utf8(header).expect("text"), &SOURCES.map(text))
}

fn sources() -> PathBuf {
    root().join("engine/bindings/c/src")
}

fn text(name: &str) -> String {
    std::fs::read_to_string(sources().join(format!("{name}.rs"))).expect("a source")
}

/// cbindgen would write ten preprocessor lines per enumeration.
const BEFORE: &str = r#"
// An enumeration of 32 bits: a type of its own in C++ and C23, a number in older C.
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
#define ZS_ENUM(name) enum name : int32_t; typedef enum name name; enum name : int32_t
#else
#define ZS_ENUM(name) typedef int32_t name; enum name
#endif

// A structure with its size set and every field at its default, as in
// `zs_camera camera = ZS_INIT(zs_camera);`.
#ifdef __cplusplus
#define ZS_INIT(type) ([] { type value_{}; value_.struct_size = sizeof(type); return value_; }())
#else
#define ZS_INIT(type) ((type){.struct_size = sizeof(type)})
#endif

#ifdef __cplusplus
extern "C" {
#endif
"#;

const AFTER: &str = r"
#undef ZS_ENUM

#ifdef __cplusplus
}
#endif

#endif // ZIPSPLAT_H
";

/// Groups declarations by source file. Each source uses only types of earlier ones.
fn by_source(header: &str, sources: &[String]) -> String {
    let (top, declarations) = header.split_once("#include <stdint.h>\n").expect("its includes");
    let mut sections = vec![String::new(); sources.len()];
    for item in declarations.trim().split("\n\n").filter(|item| !is_frame(item)) {
        let name = declared(item);
        let source = sources.iter().position(|source| declares(source, name));
        let section = &mut sections[source.unwrap_or_else(|| panic!("no source declares {name}:\n{item}"))];
        *section += &format!("\n{}\n", plain_enumeration(item));
    }
    let mut out = format!("{top}#include <stdint.h>\n{BEFORE}");
    for (source, section) in sources.iter().zip(sections) {
        let first = source.lines().next().expect("a line");
        let title = first.strip_prefix("//! ").expect("a title");
        let line = "*".repeat(title.len() + 4);
        out += &format!("\n/*{line}*/\n/*  {title}  */\n/*{line}*/\n{section}");
    }
    out + AFTER
}

fn is_frame(item: &str) -> bool {
    item.starts_with("#ifdef __cplusplus") || item.starts_with("#endif")
}

fn declared(item: &str) -> &str {
    let code = item.lines().find(|line| !line.starts_with("//")).expect("a declaration");
    let word = |text: &str| text.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(text.len());
    let behind = |mark: &str| code.split_once(mark).map(|(_, rest)| &rest[..word(rest)]);
    let keyword = ["#define ", "typedef struct ", "(*"].into_iter().find_map(behind);
    let function = || code.split_once('(').and_then(|(before, _)| before.rsplit([' ', '*']).next());
    let enumeration = code.strip_prefix("enum ").map(|rest| &rest[..word(rest)]);
    enumeration.or(keyword).or_else(function).unwrap_or_else(|| panic!("what is declared here?\n{item}"))
}

fn declares(source: &str, name: &str) -> bool {
    let ends = |rest: &str| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_');
    ["const", "enum", "struct", "type", "fn"]
        .iter()
        .any(|kind| source.split(&format!(" {kind} {name}")).skip(1).any(ends))
}

fn plain_enumeration(item: &str) -> String {
    let is_comment = |text: &str| text.lines().all(|line| line.starts_with("//"));
    let Some((comment, code)) = item.split_once("enum zs_").filter(|(before, _)| is_comment(before)) else {
        return item.to_owned();
    };
    let (name, rest) = code.split_once('\n').expect("its body");
    let (_, body) = rest.split_once("\n {\n").expect("its body behind the type");
    let (body, _) = body.split_once("\n};\n#ifndef __cplusplus").expect("the end of its body");
    format!("{comment}ZS_ENUM(zs_{name}) {{\n{body}\n}};")
}

#[test]
fn types_and_functions_of_an_object_stand_together() {
    let header = std::fs::read_to_string(root().join("engine/bindings/c/include/zipsplat.h")).expect("the header");
    let place = |text: &str| header.find(text).unwrap_or_else(|| panic!("{text} is not in the header"));
    let order = [
        "typedef struct zs_device zs_device;",
        "zs_status zs_device_create(",
        "typedef struct zs_scene zs_scene;",
        "typedef struct zs_gaussians {",
        "zs_status zs_scene_open(",
        "typedef struct zs_model zs_model;",
        "zs_status zs_model_load(",
        "typedef struct zs_refine_options {",
        "zs_status zs_refine_scene(",
        "typedef struct zs_vulkan_target {",
        "zs_status zs_render_to_vulkan(",
    ];
    assert!(order.map(place).is_sorted());
    let conditions = header.lines().filter(|line| line.starts_with("#if")).count();
    assert_eq!(conditions, 5, "the guard, ZS_ENUM, ZS_INIT, and extern \"C\" from and to");
}

/// `ZIPSPLAT_WRITE_HEADER=1` writes the header instead.
#[test]
fn is_what_the_sources_give() {
    let path = root().join("engine/bindings/c/include/zipsplat.h");
    let generated = generate();
    if std::env::var("ZIPSPLAT_WRITE_HEADER").is_ok_and(|value| value == "1") {
        std::fs::write(&path, &generated).expect("the header can be written");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == generated,
        "engine/bindings/c/include/zipsplat.h is not what engine/bindings/c/src gives; write it with\n  \
         ZIPSPLAT_WRITE_HEADER=1 tools/test.sh -p zipsplat-tests --test abi header"
    );
}
