//! PLY files against PyPI's `plyfile`.

use super::scene;
use std::path::Path;
use std::process::Command;
use zipsplat::types::{Origin, SaveOptions, World, read_points, write_ply, write_points};
use zipsplat_tests::{prelude::*, processes::python_with_numpy};

const VERSION: &str = "plyfile==1.1.5";
/// Rewrites files as binary and as text.
const REWRITE: &str = "
import sys
from plyfile import PlyData
for path in sys.argv[1:]:
    data = PlyData.read(path)
    data.write(path + '.binary')
    data.text = True
    data.write(path + '.text')
";

/// Skipped without pip or its registry.
#[test]
fn plyfile_reads_and_rewrites_ours() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let python = |program: &Path, args: &[&str], files: &[&Path]| {
        Command::new(program).args(args).args(files).env("PYTHONPATH", path("modules")).output()
    };
    let install = ["-m", "pip", "install", "--quiet", "--no-deps", "--disable-pip-version-check", VERSION, "--target"];
    let pip = python(Path::new("python3"), &install, &[&path("modules")]);
    if !pip.as_ref().is_ok_and(|pip| pip.status.success()) {
        println!("skipped: pip cannot install {VERSION}: {pip:?}");
        return;
    }
    let names = ["plain.ply", "tagged.ply", "degree3.ply", "points.ply"];
    let world = World::from(Origin::Photo("images/a b.png".into()));
    let tagged = Scene { antialiased: true, ..scene(1) };
    write_ply(&scene(0), path(names[0])).unwrap();
    tagged.save_in(path(names[1]), &SaveOptions::default(), Some(&world)).unwrap();
    scene(3).save(path(names[2])).unwrap();
    write_points(path(names[3]), &[([1.0, -2.5, 1e-3], [0, 127, 255]), ([0.0, 3e5, -1.0], [1, 2, 3])]).unwrap();
    let files = names.map(path);
    let run = python(&python_with_numpy(), &["-c", REWRITE], &files.each_ref().map(|file| file.as_path())).unwrap();
    assert!(run.status.success(), "{run:?}");
    for name in names {
        let [own, binary] = [name.into(), format!("{name}.binary")].map(|name| fs::read(path(&name)).unwrap());
        assert!(own == binary, "{name}");
        let [own, text] = [path(name), path(&format!("{name}.text"))];
        assert!(fs::read(&text).unwrap().starts_with(b"ply\nformat ascii 1.0\n"));
        if name == "points.ply" {
            assert_eq!(read_points(own).unwrap(), read_points(text).unwrap());
        } else {
            assert!(Scene::open(own).unwrap() == Scene::open(text).unwrap(), "{name}");
        }
    }
}
