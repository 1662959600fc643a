use crate::header::root;
use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::OnceLock,
};

pub struct Installation {
    pub prefix: PathBuf,
}

#[derive(Clone, Copy, Debug)]
pub enum Linking {
    Shared,
    Static,
    /// Shared, with AddressSanitizer and its leak check at exit.
    Sanitized,
}

pub fn installation() -> &'static Installation {
    static INSTALLATION: OnceLock<Installation> = OnceLock::new();
    INSTALLATION.get_or_init(|| {
        let prefix = Path::new(env!("CARGO_TARGET_TMPDIR")).join("abi");
        // Under an explicit dynamic loader, `current_exe` names the loader.
        let test = PathBuf::from(std::env::args_os().next().expect("the test's own path"));
        let mut install = Command::new(root().join("tools/install.sh"));
        install.arg(&prefix).env("ZIPSPLAT_LIBS", test.parent().expect("a folder"));
        success(install);
        Installation { prefix }
    })
}

impl Installation {
    pub fn pkg_config(&self, arguments: &[&str]) -> Vec<String> {
        let mut command = Command::new("pkg-config");
        command.args(arguments).env("PKG_CONFIG_PATH", self.prefix.join("lib/pkgconfig"));
        success(command).split_whitespace().map(str::to_owned).collect()
    }

    /// C99 (`.c`) or C++17 (`.cpp`); warnings are errors.
    pub fn compile(&self, source: &Path, linking: Linking, more: &[&str]) -> PathBuf {
        let cpp = source.extension().is_some_and(|extension| extension == "cpp");
        let (compiler, standard) = if cpp { ("c++", "-std=c++17") } else { ("cc", "-std=c99") };
        let stem = source.file_name().expect("a file").to_string_lossy().replace('.', "-");
        let program = self.prefix.join(format!("{stem}-{linking:?}"));
        let package = if matches!(linking, Linking::Static) { "zipsplat-static" } else { "zipsplat" };
        let mut command = Command::new(compiler);
        command
            .args([standard, "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-g", "-o"])
            .arg(&program)
            .arg(source);
        command.args(self.pkg_config(&["--cflags", "--libs", package])).args(more);
        if matches!(linking, Linking::Sanitized) {
            command.arg("-fsanitize=address,undefined");
        }
        command.arg(format!("-Wl,-rpath,{}", self.prefix.join("lib").display()));
        success(command);
        program
    }

    pub fn compile_text(&self, name: &str, text: &str, linking: Linking) -> PathBuf {
        let source = self.prefix.join(name);
        std::fs::write(&source, text).expect("the source can be written");
        self.compile(&source, linking, &[])
    }
}

pub fn runner(program: &Path) -> Command {
    let triple = format!("{}_UNKNOWN_LINUX_GNU", std::env::consts::ARCH.to_uppercase());
    match std::env::var_os(format!("CARGO_TARGET_{triple}_RUNNER")) {
        Some(runner) => {
            let mut command = Command::new(runner);
            command.arg(program);
            command
        }
        None => Command::new(program),
    }
}

#[track_caller]
pub fn success(mut command: Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let (out, err) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(status.success(), "{command:?}: {status}\n{out}\n{err}");
    out.into_owned()
}
