//! The committed header is what the sources give.

use cbindgen::{Builder, Config, DocumentationStyle, EnumConfig, ExportConfig, Language, RenameRule, Style};
use std::path::{Path, PathBuf};

/// Sources in the order of the header.
const SOURCES: [&str; 10] =
    ["version", "status", "context", "picture", "photo", "scene", "model", "reconstruct", "renderer", "vulkan"];

pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the repository is there")
}

/// Enumerations that structures hold as plain numbers, which the header names all the same.
const ENUMERATIONS: [&str; 7] = [
    "zs_device_kind",
    "zs_pixel_format",
    "zs_precision",
    "zs_selection",
    "zs_world",
    "zs_depth",
    "zs_requirement_kind",
];

fn generate() -> String {
    let ffi = root().join("engine/src/ffi");
    let preamble = std::fs::read_to_string(ffi.join("preamble.h")).expect("a preamble");
    let number = |name: &str| format!("{name}_value");
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
            include: ENUMERATIONS.map(str::to_owned).to_vec(),
            exclude: ENUMERATIONS.map(number).to_vec(),
            rename: ENUMERATIONS.iter().map(|name| (number(name), name.to_string())).collect(),
            ..ExportConfig::default()
        },
        ..Config::default()
    };
    let builder = SOURCES
        .iter()
        .fold(Builder::new().with_config(config), |builder, name| builder.with_src(ffi.join(format!("{name}.rs"))));
    let mut header = Vec::new();
    builder.generate().expect("the sources can be read").write(&mut header);
    String::from_utf8(header).expect("text")
}

/// `ZIPSPLAT_WRITE_HEADER=1` writes it instead.
#[test]
fn is_what_the_sources_give() {
    let path = root().join("engine/include/zipsplat.h");
    let generated = generate();
    if std::env::var("ZIPSPLAT_WRITE_HEADER").is_ok_and(|value| value == "1") {
        std::fs::write(&path, &generated).expect("the header can be written");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == generated,
        "engine/include/zipsplat.h is not what engine/src/ffi gives; write it with\n  \
         ZIPSPLAT_WRITE_HEADER=1 tools/test.sh -p zipsplat-tests --test abi header"
    );
}
