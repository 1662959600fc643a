//! Cancelling.

use crate::{Folder, command};
use std::sync::atomic::AtomicBool;
use zipsplat::types::write_ply;
use zipsplat_tests::scenes;

#[test]
fn a_cancelled_command_leaves_no_file() {
    let folder = Folder::new();
    write_ply(&scenes::random_scene(50, 0, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let before = folder.names();
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --size 28x28 -o @/out.ply",
        "render @/scene.ply --wiggle -o @/out",
        "convert @/micro.safetensors @/out.safetensors",
        "bench render --gaussians 10",
    ] {
        command(&folder.line(line), &AtomicBool::new(true)).fails(130, &["cancelled"]);
        assert_eq!(folder.names(), before, "{line}");
    }
}
