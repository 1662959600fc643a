//! The header compiles everywhere, and programs find the library in every way that is offered.

use crate::installation::{Linking, installation, runner, success};
use std::process::Command;

const PROGRAM: &str = r#"
#include <zipsplat.h>
int main(void) { return zs_abi_version() == ZS_ABI_VERSION && zs_status_name(ZS_OK)[0] == 'Z' ? 0 : 1; }
"#;

#[test]
fn as_c99_and_cpp17_shared_and_static() {
    for name in ["version.c", "version.cpp"] {
        for linking in [Linking::Shared, Linking::Static] {
            success(runner(&installation().compile_text(name, PROGRAM, linking)));
        }
    }
}

#[test]
fn versions_agree() {
    let version = installation().pkg_config(&["--modversion", "zipsplat"]);
    assert_eq!(version, [env!("CARGO_PKG_VERSION")]);
}

#[test]
fn nothing_else_is_exported() {
    let mut nm = Command::new("nm");
    nm.args(["-D", "--defined-only", "--format=just-symbols"]).arg(installation().prefix.join("lib/libzipsplat.so"));
    let symbols = success(nm);
    let others: Vec<_> = symbols.lines().filter(|symbol| !symbol.starts_with("zs_")).collect();
    assert!(symbols.contains("zs_reconstruct") && others.is_empty(), "{others:?}");
}

/// Where CMake is installed.
#[test]
fn cmake_finds_both() {
    if Command::new("cmake").arg("--version").output().is_err() {
        return eprintln!("CMake is not installed: not tested");
    }
    let folder = installation().prefix.join("cmake");
    std::fs::create_dir_all(&folder).expect("a folder");
    std::fs::write(folder.join("main.c"), PROGRAM).expect("a source");
    let project = "cmake_minimum_required(VERSION 3.16)\nproject(app C)\nfind_package(zipsplat 0.1 REQUIRED)\n\
        add_executable(shared main.c)\ntarget_link_libraries(shared zipsplat::zipsplat)\n\
        add_executable(static main.c)\ntarget_link_libraries(static zipsplat::static)\n";
    std::fs::write(folder.join("CMakeLists.txt"), project).expect("a project");
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(&folder).arg("-B").arg(folder.join("build"));
    configure.arg(format!("-DCMAKE_PREFIX_PATH={}", installation().prefix.display()));
    success(configure);
    let mut build = Command::new("cmake");
    build.arg("--build").arg(folder.join("build"));
    success(build);
    for program in ["shared", "static"] {
        success(runner(&folder.join("build").join(program)));
    }
}
