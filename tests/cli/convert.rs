//! `zipsplat convert`.

use crate::Folder;
use zipsplat::weights::Checkpoint;

#[test]
fn a_round_trip_keeps_every_value() {
    let folder = Folder::new();
    // Seeded values have few bits, so that the short types hold them too.
    for dtype in ["f32", "f16", "bf16"] {
        folder.run(&format!("convert @/micro.safetensors @/{dtype}.safetensors --dtype {dtype}")).success();
        folder.run(&format!("convert @/{dtype}.safetensors @/back.safetensors --dtype f32")).success();
        let bytes = |name: &str| std::fs::read(folder.path(name)).expect("a checkpoint");
        assert_eq!(bytes("back.safetensors"), bytes("micro.safetensors"), "{dtype}");
        let checkpoint = Checkpoint::open(folder.path(&format!("{dtype}.safetensors")), None).expect("it names itself");
        assert_eq!(checkpoint.architecture().name, "micro");
    }
    let size = |name: &str| folder.path(name).metadata().expect("a file").len();
    assert!(size("f16.safetensors") < size("f32.safetensors") * 6 / 10);
}

#[test]
fn json_tells_what_was_written() {
    let folder = Folder::new();
    let json = folder.run("convert @/micro.safetensors @/out.safetensors --dtype bf16 --json").json();
    assert_eq!(json["bytes"].as_u64(), Some(folder.path("out.safetensors").metadata().expect("a file").len()));
    assert_eq!((&json["dtype"], &json["architecture"]["width"]), (&"bf16".into(), &64.into()));
}
