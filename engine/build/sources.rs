use crate::elements::{self, Element};
use sha2::{Digest, Sha256};
use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

pub struct Source {
    /// Path below `kernels/`, such as `render/project`.
    pub kernel: String,
    /// Kernel name with any element types other than f32: `ops/layer_norm_f16`.
    pub name: String,
    pub elements: Vec<(String, Element)>,
    #[cfg_attr(not(feature = "compile-kernels"), allow(dead_code))]
    pub text: String,
    pub summary: String,
    hash: String,
}

impl Source {
    pub fn factor(&self) -> Option<Element> {
        self.elements.iter().find(|(name, _)| name == elements::FACTOR).map(|(_, element)| *element)
    }
}

pub fn find(root: &Path) -> Vec<Source> {
    let mut sources = Vec::new();
    for area in folders(root) {
        for file in entries(&root.join(&area)) {
            if let Some(stem) = file.strip_suffix(".comp") {
                sources.extend(load(root, format!("{area}/{stem}")));
            }
        }
    }
    sources
}

/// Updates stale files in `kernels/spirv/`, or fails the build without permission to.
pub fn refresh(root: &Path, kernels: &[Source]) {
    let path = root.join("spirv/manifest.txt");
    let committed: BTreeMap<String, String> = fs::read_to_string(&path)
        .unwrap_or_default()
        .lines()
        .filter_map(|line| line.split_once("  ").map(|(hash, name)| (name.to_owned(), hash.to_owned())))
        .collect();
    let everything = std::env::var_os("ZIPSPLAT_RECOMPILE_KERNELS").is_some();
    let stale: Vec<_> = kernels
        .iter()
        .filter(|k| {
            everything
                || committed.get(&k.name) != Some(&k.hash)
                || !root.join(format!("spirv/{}.spv", k.name)).is_file()
        })
        .collect();
    if !stale.is_empty() {
        compile(root, &stale);
    }
    if cfg!(feature = "compile-kernels") {
        let manifest: String = kernels.iter().map(|k| format!("{}  {}\n", k.hash, k.name)).collect();
        if fs::read_to_string(&path).ok().as_ref() != Some(&manifest) {
            fs::write(&path, manifest).expect("kernels/spirv is writable");
        }
        remove_orphans(root, kernels);
    }
}

#[cfg(not(feature = "compile-kernels"))]
fn compile(_root: &Path, stale: &[&Source]) {
    let names: Vec<_> = stale.iter().map(|k| k.name.as_str()).collect();
    panic!(
        "kernels newer than their committed SPIR-V: {}; build with `--features zipsplat/compile-kernels`",
        names.join(", ")
    );
}

#[cfg(feature = "compile-kernels")]
fn compile(root: &Path, stale: &[&Source]) {
    let compiler = shaderc::Compiler::new().expect("shaderc");
    let mut options = shaderc::CompileOptions::new().expect("shaderc");
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_3 as u32);
    options.set_optimization_level(shaderc::OptimizationLevel::Zero);
    options.set_warnings_as_errors();
    for kernel in stale {
        // More tools support 1.5.
        let newest = kernel.text.contains("GL_NV_cooperative_matrix2");
        options.set_target_spirv(if newest { shaderc::SpirvVersion::V1_6 } else { shaderc::SpirvVersion::V1_5 });
        let file = format!("kernels/{}.comp", kernel.kernel);
        let spirv = compiler
            .compile_into_spirv(&kernel.text, shaderc::ShaderKind::Compute, &file, "main", Some(&options))
            .unwrap_or_else(|e| panic!("{e}"));
        crate::validate::validate(spirv.as_binary()).unwrap_or_else(|e| panic!("{}: {e}", kernel.name));
        let path = root.join(format!("spirv/{}.spv", kernel.name));
        fs::create_dir_all(path.parent().expect("has a folder")).expect("kernels/spirv is writable");
        fs::write(path, spirv.as_binary_u8()).expect("kernels/spirv is writable");
    }
}

fn remove_orphans(root: &Path, kernels: &[Source]) {
    for area in folders(&root.join("spirv")) {
        for file in entries(&root.join("spirv").join(&area)) {
            let name = format!("{area}/{}", file.trim_end_matches(".spv"));
            if !kernels.iter().any(|k| k.name == name) {
                fs::remove_file(root.join("spirv").join(&area).join(file)).expect("kernels/spirv is writable");
            }
        }
    }
}

fn load(root: &Path, kernel: String) -> Vec<Source> {
    let text = with_includes(root, &format!("{kernel}.comp"), &mut BTreeSet::new());
    let summary = text
        .lines()
        .map_while(|l| l.strip_prefix("//"))
        .map(|l| l.trim())
        .take_while(|l| !l.is_empty())
        .collect::<Vec<_>>()
        .join(" ");
    let module = |elements: Vec<(String, Element)>| {
        let is_plain = elements.iter().all(|(_, element)| *element == Element::F32);
        let types: String = elements.iter().map(|(_, element)| format!("_{}", element.name())).collect();
        let name = if is_plain { kernel.clone() } else { format!("{kernel}{types}") };
        let text = elements::defined(&text, &elements);
        let hash = hash(&text);
        Source { kernel: kernel.clone(), name, elements, text, summary: summary.clone(), hash }
    };
    elements::choices(&text).into_iter().map(module).collect()
}

fn hash(text: &str) -> String {
    Sha256::digest(text).iter().map(|b| format!("{b:02x}")).collect()
}

/// Resolves each `#include "shared/x.glsl"` once; keeps the outer file's line numbers.
fn with_includes(root: &Path, file: &str, seen: &mut BTreeSet<String>) -> String {
    let source = fs::read_to_string(root.join(file)).unwrap_or_else(|e| panic!("kernels/{file}: {e}"));
    let mut text = String::new();
    for (number, line) in source.lines().enumerate() {
        match line.trim().strip_prefix("#include \"").and_then(|l| l.strip_suffix('"')) {
            Some(included) => {
                assert!(included.starts_with("shared/"), "kernels/{file}: may include only shared/, not {included}");
                if seen.insert(included.to_owned()) {
                    text += &with_includes(root, included, seen);
                }
                text += &format!("#line {}\n", number + 2);
            }
            None => text += &format!("{line}\n"),
        }
    }
    text
}

pub fn folders(root: &Path) -> Vec<String> {
    entries(root).into_iter().filter(|n| root.join(n).is_dir()).collect()
}

fn entries(folder: &Path) -> Vec<String> {
    let Ok(list) = fs::read_dir(folder) else { return Vec::new() };
    let mut names: Vec<_> =
        list.filter_map(|e| e.ok()?.file_name().into_string().ok()).filter(|n| !n.starts_with('.')).collect();
    names.sort();
    names
}
