use crate::{
    header::root,
    installation::{Linking, installation, runner, success},
};
use std::{path::Path, process::Command};

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
fn as_the_readme_says() {
    let readme = std::fs::read_to_string(root().join("engine/examples/README.md")).expect("how to embed");
    let line = readme.lines().map(str::trim).find(|line| line.starts_with("cc app.c ")).expect("how to compile an app");
    let app = line.split_once(" -o ").map_or("a.out", |(_, rest)| rest.split(' ').next().unwrap_or(rest));
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("app.c"), PROGRAM).expect("a source");
    let lib = installation().prefix.join("lib");
    for line in [line, &format!("./{app}")] {
        let mut command = Command::new("bash");
        command.args(["-c", line]).current_dir(&folder);
        command.env("PKG_CONFIG_PATH", lib.join("pkgconfig")).env("LD_LIBRARY_PATH", &lib);
        success(command);
    }
}

#[test]
fn a_prefix_that_cannot_be_written_is_refused_before_anything_is_built() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("file");
    std::fs::write(&file, "").expect("a file");
    let mut install = Command::new(root().join("tools/install.sh"));
    // Without cargo, as under sudo.
    install.arg(file.join("prefix")).env_remove("ZIPSPLAT_LIBS").env("CARGO_HOME", folder.path());
    let failed = install.env("PATH", "/usr/bin:/bin").output().expect("the script runs");
    let message = String::from_utf8_lossy(&failed.stderr);
    assert!(!failed.status.success() && message.contains("cannot write to"), "{message}");
}

#[test]
fn versions_agree() {
    let version = installation().pkg_config(&["--modversion", "zipsplat"]);
    assert_eq!(version, [env!("CARGO_PKG_VERSION")]);
}

#[test]
fn pkg_config_says_where_things_are() {
    let found = |prefix: &Path, lib: &str, variable: &str| {
        let mut command = Command::new("pkg-config");
        command.args([&format!("--variable={variable}"), "zipsplat"]);
        command.env("PKG_CONFIG_PATH", prefix.join(lib).join("pkgconfig"));
        Path::new(success(command).trim()).canonicalize().ok()
    };
    let folder = tempfile::tempdir().expect("a folder");
    for name in ["libzipsplat_c.a", "libzipsplat_c.so"] {
        std::fs::write(folder.path().join(name), "").expect("a file");
    }
    for lib in ["lib", "lib64", "lib/x86_64-linux-gnu"] {
        let prefix = folder.path().join(lib.replace('/', "-"));
        let mut install = Command::new(root().join("tools/install.sh"));
        install.arg(&prefix).env("ZIPSPLAT_LIBS", folder.path());
        if lib != "lib" {
            install.env("ZIPSPLAT_LIBDIR", lib);
        }
        success(install);
        for variable in ["prefix", "exec_prefix"] {
            assert_eq!(found(&prefix, lib, variable), prefix.canonicalize().ok(), "{variable}, {lib}");
        }
        assert_eq!(found(&prefix, lib, "libdir"), prefix.join(lib).canonicalize().ok());
        assert_eq!(found(&prefix, lib, "includedir"), prefix.join("include").canonicalize().ok());
        assert!(prefix.join(lib).join("libzipsplat.so").exists() && prefix.join("include/zipsplat.h").exists());
    }
    let mut outside = Command::new(root().join("tools/install.sh"));
    outside.arg(folder.path().join("outside")).env("ZIPSPLAT_LIBS", folder.path()).env("ZIPSPLAT_LIBDIR", "../lib");
    let failed = outside.output().expect("the script runs");
    let message = String::from_utf8_lossy(&failed.stderr);
    assert!(!failed.status.success() && message.contains("ZIPSPLAT_LIBDIR: found ../lib"), "{message}");
}

#[test]
fn nothing_else_is_exported() {
    let mut nm = Command::new("nm");
    nm.args(["-D", "--defined-only", "--format=just-symbols"]).arg(installation().prefix.join("lib/libzipsplat.so"));
    let symbols = success(nm);
    let others: Vec<_> = symbols.lines().filter(|symbol| !symbol.starts_with("zs_")).collect();
    assert!(symbols.contains("zs_reconstruct") && others.is_empty(), "{others:?}");
}

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
