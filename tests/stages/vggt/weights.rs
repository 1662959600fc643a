use crate::depth::architecture;
use std::collections::BTreeMap;
use tempfile::TempDir;
use zipsplat::weights::{DepthArchitecture, DepthCheckpoint, DepthHeads};
use zipsplat_tests::prelude::*;

#[test]
fn released_layouts_of_vggt_are_read() {
    let Some(path) = golden::find("vggt_micro.weights.safetensors") else { return };
    let a = architecture("vggt_micro");
    let seeded = DepthCheckpoint::seeded(a.clone(), "vggt_micro").unwrap();
    let read = DepthCheckpoint::open_architecture(&path, a.clone()).unwrap();
    assert!(network::weights(&read).unwrap() == network::weights(&seeded).unwrap());
    // Saved with its architecture.
    let folder = TempDir::new().unwrap();
    let saved = folder.path().join("saved.safetensors");
    let smaller = DepthCheckpoint::open_architecture(&path, DepthArchitecture { points: false, ..a.clone() }).unwrap();
    smaller.save_with(&saved, Dtype::F32, |_| ControlFlow::Continue(())).unwrap();
    let again = DepthCheckpoint::open(&saved, DepthHeads::default()).unwrap();
    assert_eq!(again.architecture(), smaller.architecture());
    assert!(DepthCheckpoint::is_meant(saved.to_str().unwrap()) && again.parameters().len() < read.parameters().len());
    assert_refused(
        DepthCheckpoint::open(&path, DepthHeads { gaussians: true, points: false }),
        &["vggt-1b", "da3-giant"],
    );
    assert!(matches!(DepthCheckpoint::open(&path, DepthHeads::default()), Err(Error::Weights { .. })));
}

#[test]
fn vggt_is_as_released() {
    let Some(keys) = golden::json("vggt_1b.keys.json") else { return };
    let mut released = BTreeMap::new();
    for (name, of) in keys["params"].as_object().expect("shapes by name") {
        // {} counts equal layers.
        let count = name.contains("{}").then(|| of[0].as_u64().expect("a number"));
        let shape: Vec<usize> = serde_json::from_value(count.map_or(of, |_| &of[1]).clone()).expect("a shape");
        released.extend((0..count.unwrap_or(1)).map(|i| (name.replace("{}", &i.to_string()), shape.clone())));
    }
    assert_eq!(released.len(), 1797);
    let large = DepthArchitecture { points: true, ..DepthArchitecture::named("vggt-1b").unwrap() };
    large.validate().unwrap();
    let parameters = large.parameters();
    for (name, shape) in &parameters {
        assert_eq!(released.get(name), Some(shape), "{name}");
    }
    let known = |name: &str| parameters.iter().any(|(other, _)| other == name);
    let unread = released.keys().filter(|name| !known(name) && !name.starts_with("track_head."));
    assert_eq!(unread.collect::<Vec<_>>(), ["aggregator.patch_embed.mask_token"]);
    let used = DepthArchitecture::named("vggt-1b").unwrap().parameter_count();
    assert_eq!((used + 500_000) / 1_000_000, 1158);
}

#[test]
fn impossible_sizes_of_vggt_are_refused() {
    let a = architecture_of_tiny();
    let refused = |change: &dyn Fn(&mut DepthArchitecture), words: &[&str]| {
        let mut wrong = a.clone();
        change(&mut wrong);
        assert_refused(wrong.validate(), words);
    };
    refused(&|a| a.backbone.out_layers[0] -= 1, &["out_layers", "pairs"]);
    refused(&|a| a.backbone.alt_start += 1, &["out_layers", "pairs"]);
    refused(&|a| a.camera_head = None, &["camera_head"]);
    refused(&|a| a.camera_head.as_mut().unwrap().heads = 7, &["camera_head"]);
    refused(&|a| a.backbone.width = 48, &["width", "32"]);
}

fn architecture_of_tiny() -> DepthArchitecture {
    DepthArchitecture::vggt("tiny", 64, [1, 4], [0, 1, 2, 3], 8, [8; 4])
}
