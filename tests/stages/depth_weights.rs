use safetensors::{Dtype, tensor::TensorView};
use tempfile::TempDir;
use zip::CompressionMethod;
use zipsplat::ops::Ffn;
use zipsplat::weights::{DEPTH_MODELS, DepthArchitecture, DepthCheckpoint, DepthHeads};
use zipsplat_tests::{pickles::*, prelude::*};

fn tiny() -> DepthArchitecture {
    let tiny = DepthArchitecture::new("da3_tiny", [128, 6, 2], Ffn::Gelu, [2, 3, 4, 5], 32, [16, 24, 32, 48]);
    DepthArchitecture { gaussians: true, ..tiny }
}

fn manifest(config: &str) -> Option<Vec<(String, Vec<usize>)>> {
    let manifest = golden::json(&format!("{config}.manifest.json"))?;
    let parameters = manifest["params"].as_object().expect("parameters");
    let shape = |shape: &serde_json::Value| serde_json::from_value(shape.clone()).expect("a shape");
    Some(parameters.iter().map(|(name, of)| (name.clone(), shape(of))).collect())
}

/// With the values of `of` where it has them.
fn write(path: &Path, tensors: &[(String, Vec<usize>)], of: Option<&DepthCheckpoint>) {
    let values = |(name, shape): &(String, Vec<usize>)| {
        let mut values = vec![0.0; shape.iter().product()];
        of.into_iter().for_each(|checkpoint| drop(checkpoint.read_f32(name, &mut values)));
        values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>()
    };
    let bytes: Vec<Vec<u8>> = tensors.iter().map(values).collect();
    let views = tensors.iter().zip(&bytes).map(|((name, shape), bytes)| {
        (name.clone(), TensorView::new(Dtype::F32, shape.clone(), bytes).expect("as many bytes as the shape has"))
    });
    safetensors::serialize_to_file(views, None, path).expect("a file");
}

#[test]
fn released_layouts_are_read() {
    let Some(tensors) = manifest("da3_tiny") else { return };
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("model.safetensors");
    let seeded = DepthCheckpoint::seeded(tiny(), "da3_tiny").unwrap();
    write(&path, &tensors, Some(&seeded));
    let read = DepthCheckpoint::open_architecture(&path, tiny()).unwrap();
    assert_eq!(read.parameters(), seeded.parameters());
    for (name, shape) in seeded.parameters() {
        let values = |checkpoint: &DepthCheckpoint| {
            let mut values = vec![f32::NAN; shape.iter().product()];
            checkpoint.read_f32(name, &mut values).unwrap();
            values
        };
        assert!(values(&read) == values(&seeded), "{name}");
    }
    let known = |name: &str| seeded.parameters().iter().any(|(other, _)| other == name);
    let unread: Vec<&String> = tensors.iter().map(|(name, _)| name).filter(|name| !known(name)).collect();
    assert!(unread.iter().all(|name| name.contains("_aux.")), "{unread:?}");
}

#[test]
fn archives_of_pytorch_are_read() {
    let vggt = DepthArchitecture::vggt("tiny", 64, [1, 4], [0, 1, 2, 3], 8, [8; 4]);
    let seeded = DepthCheckpoint::seeded(vggt.clone(), "tiny").unwrap();
    let stored = |(i, (name, shape)): (usize, &(String, Vec<usize>))| {
        let mut values: Vec<f32> = vec![0.0; shape.iter().product()];
        seeded.read_f32(name, &mut values).unwrap();
        let (key, elements, strides) = (i.to_string(), values.len(), row_major(shape));
        let view = View { kind: "FloatStorage", key: &key, elements, offset: 0, shape, strides: &strides };
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        ((name.clone(), view.pickle()), (format!("data/{key}"), bytes))
    };
    let (tensors, storages): (Vec<_>, Vec<_>) = seeded.parameters().iter().enumerate().map(stored).unzip();
    let tensors: Vec<_> = tensors.iter().map(|(name, pickle)| (name.as_str(), pickle.clone())).collect();
    let pickle = [b"\x80\x02".to_vec(), dict(&tensors), b".".to_vec()].concat();
    let storages = storages.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice()));
    let entries: Vec<_> = [("data.pkl", pickle.as_slice())].into_iter().chain(storages).collect();
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("model.pt");
    std::fs::write(&path, archive(&entries, CompressionMethod::Stored)).unwrap();
    assert!(DepthCheckpoint::is_meant(path.to_str().unwrap()));
    let read = DepthCheckpoint::open_architecture(&path, vggt).unwrap();
    assert!(network::weights(&read).unwrap() == network::weights(&seeded).unwrap());
}

#[test]
fn nested_networks_give_the_multi_view_one() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("model.safetensors");
    let small = DepthArchitecture::named("da3-small").unwrap();
    let of = |nested: &str, alone: DepthArchitecture| {
        let renamed = |(name, shape): (String, Vec<usize>)| (name.replacen("model.", nested, 1), shape);
        alone.parameters().into_iter().map(renamed).collect::<Vec<_>>()
    };
    let tensors = [of("model.da3.", small.clone()), of("model.da3_metric.", tiny())].concat();
    write(&path, &tensors, None);
    assert!(DepthCheckpoint::is_meant(path.to_str().unwrap()));
    assert_eq!(*DepthCheckpoint::open(&path, DepthHeads::default()).unwrap().architecture(), small);
}

#[test]
fn missing_and_foreign_tensors_are_named() {
    let Some(mut tensors) = manifest("da3_tiny") else { return };
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("model.safetensors");
    let lost = tensors.iter().position(|(name, _)| name == "model.head.projects.2.bias").unwrap();
    tensors[lost].0 = "model.head.projects.7.bias".into();
    write(&path, &tensors, None);
    match DepthCheckpoint::open_architecture(&path, tiny()) {
        Err(Error::Weights { missing, unexpected, misshapen, .. }) => {
            assert_eq!(missing, ["model.head.projects.2.bias"]);
            assert_eq!(unexpected, ["model.head.projects.7.bias"]);
            assert!(misshapen.is_empty());
        }
        other => panic!("{other:?}"),
    }
    assert_refused(DepthCheckpoint::open(&path, DepthHeads::default()), &["width 128", "da3-base"]);
}

#[test]
fn networks_are_told_by_their_shapes() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("model.safetensors");
    let small = DepthArchitecture::named("da3-small").unwrap();
    write(&path, &small.parameters(), None);
    let found = DepthCheckpoint::open(&path, DepthHeads::default()).unwrap();
    assert_eq!(*found.architecture(), small);
    assert_refused(
        DepthCheckpoint::open(&path, DepthHeads { gaussians: true, points: false }),
        &["da3-small", "da3-giant"],
    );
    for name in DEPTH_MODELS {
        let architecture = DepthArchitecture::named(name).unwrap();
        architecture.validate().unwrap();
        assert!(architecture.parameters().len() > 150, "{name}");
    }
}

/// In millions.
#[test]
fn networks_are_as_large_as_released() {
    let released = [
        ("da3-small", 34.0),
        ("da3-base", 135.0),
        ("da3-large", 411.0),
        ("da3-giant", 1356.0),
        ("da3mono-large", 334.0),
    ];
    for (name, millions) in released {
        let parameters = DepthArchitecture::named(name).unwrap().parameters();
        let count: usize = parameters.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
        let found = count as f64 / 1e6;
        assert!(
            found <= 1.02 * millions && found > 0.9 * millions,
            "{name}: {found} M parameters, released {millions} M"
        );
    }
}
