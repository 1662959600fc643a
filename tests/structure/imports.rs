use crate::source::{Source, files, paths, tokens};
use std::collections::{BTreeMap, BTreeSet};

/// Each uses only those before it; the first four are crates. `error` is `Error` and `Result`. The
/// crates enforce the rest: only `engine/gpu` uses Vulkan, and of the engine the references use
/// only `engine/random`.
const LAYERS: [&str; 14] = [
    "error",
    "gpu",
    "types",
    "random",
    "ops",
    "tune",
    "stages",
    "weights",
    "perceptual",
    "features",
    "cameras",
    "reconstruct",
    "depth",
    "refine",
];

const DISPATCHING: [&str; 3] = ["ops", "stages", "refine"];

/// Unsafe code: validation of kernels, the C ABI and its calls, and memory mapping of checkpoints.
const UNSAFE: [&str; 5] =
    ["engine/build.rs", "engine/gpu/src/", "engine/bindings/c/src/", "engine/src/weights/source.rs", "tests/abi/"];

const ROOTS: [&str; 7] = [
    "engine/src/",
    "engine/gpu/src/",
    "engine/formats/src/",
    "engine/bindings/c/src/",
    "tools/src/",
    "kernels/verify/",
    "kernels/reference/",
];

fn engine() -> Vec<Source> {
    files("engine/src", "rs")
}

/// `stages/backbone/mod.rs` is `[stages, backbone]`.
fn module(path: &str) -> Vec<&str> {
    let inside = ROOTS.iter().find_map(|root| path.strip_prefix(root)).unwrap_or(path).trim_end_matches(".rs");
    inside.split('/').filter(|part| !["mod", "lib"].contains(part)).collect()
}

/// Outside unit tests.
fn used(source: &Source) -> Vec<Vec<String>> {
    let own = module(&source.path);
    let absolute = |path: Vec<String>| {
        let supers = path.iter().take_while(|part| *part == "super").count();
        let base = if supers > 0 { &own[..own.len().saturating_sub(supers)] } else { &[] };
        let rest = path.iter().skip_while(|part| *part == "super" || *part == "crate");
        base.iter().map(|part| part.to_string()).chain(rest.cloned()).collect()
    };
    let (code, _unit_tests) = source.text.split_once("#[cfg(test)]").unwrap_or((&source.text, ""));
    paths(&tokens(code), &["crate", "super"]).into_iter().map(absolute).collect()
}

fn problem(own: &[&str], path: &[String], stages: &[String]) -> Option<String> {
    let (layer, named) = (own[0], path.first()?.as_str());
    if named == "kernels" {
        // The cache's key includes the kernels.
        let listed = layer == "tune" && path.get(1).is_some_and(|part| part == "MODULES");
        return (!listed && !DISPATCHING.contains(&layer)).then(|| format!("{layer} dispatches no kernels"));
    }
    let named = if named.starts_with(char::is_uppercase) { "error" } else { named };
    let place = |name: &str| LAYERS.iter().position(|layer| *layer == name);
    let (Some(own_place), Some(other)) = (place(layer), place(named)) else {
        return Some(format!("{layer} or {named} is no layer that this test knows"));
    };
    if other > own_place {
        return Some(format!("{layer} stands before {named}"));
    }
    let other = path.get(1).filter(|stage| layer == "stages" && named == "stages" && stages.contains(stage))?;
    (own.get(1) != Some(&other.as_str()) && own.len() > 1).then(|| format!("stage {} knows stage {other}", own[1]))
}

#[test]
fn layers_use_only_those_before() {
    let sources = engine();
    let stage = |source: &Source| {
        module(&source.path).get(1).filter(|_| source.path.contains("/stages/")).map(|s| s.to_string())
    };
    let stages: Vec<String> = sources.iter().filter_map(stage).collect();
    assert!(stages.len() >= 5 && sources.len() > 30, "stages are found");
    let mut problems = Vec::new();
    for source in sources.iter().filter(|source| source.path != "engine/src/lib.rs") {
        let own = module(&source.path);
        let wrong = used(source).into_iter().filter_map(|path| {
            problem(&own, &path, &stages).map(|problem| format!("{}: {}: {problem}", source.path, path.join("::")))
        });
        problems.extend(wrong);
    }
    assert!(problems.is_empty(), "\n{}", problems.join("\n"));
}

/// Modules in circles, with their uses.
fn circles(sources: &[Source]) -> BTreeMap<String, BTreeSet<String>> {
    let modules: BTreeSet<String> = sources.iter().map(|source| module(&source.path).join("/")).collect();
    let uses = |source: &Source| {
        let own = module(&source.path).join("/");
        let named =
            |path: Vec<String>| (1..=path.len()).rev().map(|i| path[..i].join("/")).find(|m| modules.contains(m));
        let is_apart =
            |m: &String| !format!("{own}/").starts_with(&format!("{m}/")) && !m.starts_with(&format!("{own}/"));
        let others = used(source).into_iter().filter_map(named).filter(is_apart).collect();
        (own, others)
    };
    let mut left: BTreeMap<String, BTreeSet<String>> = sources.iter().map(uses).collect();
    loop {
        let before: BTreeSet<String> = left.keys().cloned().collect();
        left.retain(|_, others| others.intersection(&before).next().is_some());
        if left.len() == before.len() {
            return left;
        }
    }
}

#[test]
fn modules_form_no_circles() {
    for root in ROOTS {
        let found = circles(&files(root.trim_end_matches('/'), "rs"));
        assert!(found.is_empty(), "{root}: {found:?}");
    }
    let source = |path: &str, text: &str| Source { path: path.into(), text: text.into() };
    let [a, b] =
        [source("tools/src/a/mod.rs", "mod c; use crate::b::B;"), source("tools/src/b.rs", "use super::a::c::C;")];
    let c = |text| source("tools/src/a/c.rs", text);
    assert!(circles(&[a.clone(), b.clone(), c("use super::A;")]).is_empty());
    assert_eq!(circles(&[a, b, c("use crate::b;")]).len(), 3);
}

#[test]
fn wrong_uses_are_found() {
    let source = |path: &str, text: &str| Source { path: path.into(), text: text.into() };
    let problems = |path: &str, text: &str| {
        let stages = ["cluster".to_owned(), "fuse".to_owned()];
        let found = used(&source(path, text));
        found.iter().filter_map(|used| problem(&module(path), used, &stages)).count()
    };
    assert_eq!(
        problems("engine/src/ops/norm.rs", "use crate::{Error, gpu::Run, refine::Adam, kernels::limits::A};"),
        1
    );
    assert_eq!(problems("engine/src/weights/tensor.rs", "use crate::kernels::ops::Add; use super::Image;"), 1);
    assert_eq!(problems("engine/src/stages/fuse.rs", "use super::{ViewGrid, cluster::record};"), 1);
    assert_eq!(
        problems("engine/src/stages/fuse/a.rs", "use super::super::cluster; use super::b; use crate::stages::X;"),
        1
    );
    assert_eq!(problems("engine/src/stages/mod.rs", "use crate::gpu::Tensor; use self::fuse::Fuse;"), 0);
    assert_eq!(problems("engine/src/ops/norm.rs", "fn f() { crate::stages::cluster::record() }"), 1);
}

/// The compiler denies other unsafe code.
#[test]
fn unsafe_code_is_where_it_belongs() {
    for source in ["engine", "kernels", "tools", "tests"].iter().flat_map(|folder| files(folder, "rs")) {
        let allows = tokens(&source.text).windows(3).any(|code| code == ["allow", "(", "unsafe_code"]);
        assert!(!allows || UNSAFE.iter().any(|place| source.path.starts_with(place)), "unsafe in {}", source.path);
    }
}

#[test]
fn kernels_include_only_what_is_shared() {
    let kernels: Vec<Source> = files("kernels", "comp").into_iter().chain(files("kernels", "glsl")).collect();
    let includes = |source: &Source| -> Vec<String> {
        let lines = source.text.lines().filter_map(|line| line.trim().strip_prefix("#include"));
        lines.map(|name| name.trim().trim_matches('"').to_owned()).collect()
    };
    assert!(kernels.iter().any(|source| !includes(source).is_empty()), "includes are found");
    for source in &kernels {
        for name in includes(source) {
            assert!(name.starts_with("shared/"), "{} includes {name}", source.path);
        }
    }
}
