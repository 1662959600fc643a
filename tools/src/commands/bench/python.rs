use crate::scratch::Scratch;
use serde::{Deserialize, de::DeserializeOwned};
use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
};
use zipsplat::{
    Error, Result,
    types::{Scene, write_ply},
};

pub struct Script {
    option: &'static str,
    /// Requirements, for errors of `option`.
    needed: &'static str,
    /// Python code that fails without them.
    check: &'static str,
    /// Sources by file name, the script first.
    files: &'static [(&'static str, &'static str)],
}

const SCENE: (&str, &str) = ("scene.py", include_str!("../../../bench/scene.py"));
const TIMING: (&str, &str) = ("timing.py", include_str!("../../../bench/timing.py"));
const MODEL: (&str, &str) = ("model.py", include_str!("../../../train/model.py"));
const VGGT: (&str, &str) = ("vggt.py", include_str!("../../../train/vggt.py"));
const LAYERS: (&str, &str) = ("layers.py", include_str!("../../../train/layers.py"));
const WEIGHTS: (&str, &str) = ("weights.py", include_str!("../../../train/weights.py"));
const REFINE_PY: &str = include_str!("../../../bench/pytorch_refine.py");
const GSPLAT_PY: &str = include_str!("../../../bench/gsplat_render.py");

pub const FORWARD: Script = Script {
    option: "--pytorch",
    needed: "a Python with torch, numpy and safetensors",
    check: "import torch, numpy, safetensors",
    files: &[
        ("pytorch_forward.py", include_str!("../../../bench/pytorch_forward.py")),
        TIMING,
        MODEL,
        VGGT,
        LAYERS,
        WEIGHTS,
    ],
};

pub const DEPTH: Script = Script {
    files: &[
        ("pytorch_depth.py", include_str!("../../../bench/pytorch_depth.py")),
        TIMING,
        ("depth.py", include_str!("../../../train/depth.py")),
        MODEL,
        VGGT,
        LAYERS,
        WEIGHTS,
    ],
    ..FORWARD
};

pub const REFINE: Script = Script {
    option: "--pytorch",
    needed: "a Python with torch, numpy and, without a CUDA GPU, numba",
    check: REFINE_PY,
    files: &[
        ("pytorch_refine.py", REFINE_PY),
        SCENE,
        TIMING,
        ("rasterize.py", include_str!("../../../train/rasterize.py")),
        ("rasterize_numba.py", include_str!("../../../train/rasterize_numba.py")),
        ("rasterize_triton.py", include_str!("../../../train/rasterize_triton.py")),
        ("splats.py", include_str!("../../../train/splats.py")),
    ],
};

pub const GSPLAT: Script = Script {
    option: "--gsplat",
    needed: "a Python with PyTorch and gsplat, on a CUDA GPU",
    check: GSPLAT_PY,
    files: &[("gsplat_render.py", GSPLAT_PY), SCENE],
};

#[derive(Deserialize)]
pub struct Pytorch<Row> {
    device: String,
    torch: String,
    pub rows: Vec<Row>,
}

impl<Row> Pytorch<Row> {
    pub fn name(&self) -> String {
        format!("PyTorch {} on {}", self.torch, self.device)
    }
}

impl Script {
    pub fn check(&self, python: &Path) -> Result<()> {
        self.output(Command::new(python).args(["-c", self.check])).map(drop)
    }

    /// Runs the script with the file of `scene`, if any, and `args`.
    pub fn run<T: DeserializeOwned>(
        &self,
        python: &Path,
        scene: Option<&Scene>,
        args: impl IntoIterator<Item = String>,
    ) -> Result<T> {
        let folder = Scratch::new()?;
        for (name, text) in self.files {
            let path = folder.path().join(name);
            fs::write(&path, text).map_err(|error| Error::io(path, error))?;
        }
        let mut command = Command::new(python);
        command.arg(folder.path().join(self.files[0].0));
        if let Some(scene) = scene {
            let file = folder.path().join("scene.ply");
            write_ply(scene, &file)?;
            command.arg(file);
        }
        let printed = self.output(command.args(args))?;
        serde_json::from_str(&printed)
            .map_err(|error| Error::argument(self.option, format!("{}: {error}", python.display()), self.needed))
    }

    fn output(&self, command: &mut Command) -> Result<String> {
        let python = command.get_program().display().to_string();
        let failed = |message: &str| Error::argument(self.option, format!("{python}: {message}"), self.needed);
        let output = command.stdin(Stdio::null()).output().map_err(|error| failed(&error.to_string()))?;
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            return Err(failed(message.trim().lines().last().unwrap_or("it failed")));
        }
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scripts_find_what_they_import() {
        let tools = Path::new(env!("CARGO_MANIFEST_DIR"));
        for Script { files, .. } in [FORWARD, DEPTH, REFINE, GSPLAT] {
            for (name, text) in files {
                let words = text.lines().filter_map(|line| {
                    let line = line.trim_start();
                    line.strip_prefix("from ").or_else(|| line.strip_prefix("import "))?.split([' ', ',', '.']).next()
                });
                let own = words
                    .map(|word| format!("{word}.py"))
                    .filter(|file| ["train", "bench"].iter().any(|folder| tools.join(folder).join(file).exists()));
                for file in own {
                    assert!(files.iter().any(|(other, _)| *other == file), "{name} imports {file}");
                }
            }
        }
    }
}
