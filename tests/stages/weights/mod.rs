mod large;
mod malformed;
mod q8;
mod torch;
mod trained;

use safetensors::Dtype as FileDtype;
use safetensors::tensor::{Metadata, TensorInfo};
use serde_json::Value;
use std::collections::HashMap;
use zipsplat::weights::convert;
use zipsplat_tests::architectures::{golden, pico};
use zipsplat_tests::prelude::*;

fn data(name: &str) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(name);
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn shared(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/golden/data").join(name);
    if !path.exists() {
        println!("skipped: {} is absent", path.display());
    }
    path.exists().then_some(path)
}

fn shape(value: &Value) -> Vec<usize> {
    value.as_array().unwrap().iter().map(|size| size.as_u64().unwrap() as usize).collect()
}

fn read(checkpoint: &Checkpoint, name: &str) -> Vec<f32> {
    let mut values = vec![f32::NAN; checkpoint.shape(name).unwrap().iter().product()];
    checkpoint.read_f32(name, &mut values).unwrap();
    values
}

fn assert_same_bits(found: &Checkpoint, expected: &Checkpoint) {
    assert!(found.tensor_names().eq(expected.tensor_names()));
    for name in expected.tensor_names() {
        let bits = |checkpoint| read(checkpoint, name).into_iter().map(f32::to_bits).collect::<Vec<u32>>();
        assert!(bits(found) == bits(expected), "{name}");
    }
}

fn pico_weights() -> Checkpoint {
    Checkpoint::seeded_architecture(pico(), "pico").unwrap()
}

fn header(tensors: &[(String, Vec<usize>)]) -> (Vec<u8>, usize) {
    let mut end = 0;
    let infos = tensors.iter().map(|(name, shape)| {
        let start = end;
        end += 2 * shape.iter().product::<usize>();
        (name.clone(), TensorInfo { dtype: FileDtype::F16, shape: shape.clone(), data_offsets: (start, end) })
    });
    let json = serde_json::to_vec(&Metadata::new(None, infos.collect()).unwrap()).unwrap();
    ([&(json.len() as u64).to_le_bytes(), json.as_slice()].concat(), end)
}

fn write_zeros(path: &Path, tensors: &[(String, Vec<usize>)]) {
    let (header, values) = header(tensors);
    std::fs::write(path, &header).unwrap();
    let file = std::fs::File::options().write(true).open(path).unwrap();
    file.set_len((header.len() + values) as u64).unwrap();
}

#[test]
fn parameters_are_those_of_the_reference() {
    for config in ["tiny", "tiny_swiglu", "micro", "small", "giant_slice"] {
        let manifest = data(&format!("{config}.manifest.json"));
        let expected = manifest["params"].as_object().unwrap();
        let architecture = golden(config);
        architecture.validate().unwrap();
        let found = architecture.parameters();
        for (name, found) in &found {
            let expected = expected.get(name).map(shape);
            assert_eq!(Some(found), expected.as_ref(), "{config}/{name}");
        }
        assert_eq!(found.len(), expected.len(), "{config}");
        assert_eq!(Some(architecture.parameter_count() as u64), manifest["n_params"].as_u64(), "{config}");

        let conf = &manifest["conf"];
        assert_eq!(architecture.out_layers, shape(&conf["out_layers"]));
        assert_eq!(Some(architecture.gaussians_per_token as u64), conf["gaussians_per_token"].as_u64());
        assert_eq!(Some(architecture.sh_degree as u64), conf["sh_degree"].as_u64());
    }
}

#[test]
fn variants_have_the_published_sizes() {
    let expected = [
        ("vits", 46_235_232, 485),
        ("vitb", 180_750_816, 485),
        ("vitl", 470_843_104, 685),
        ("vitg", 1_447_701_472, 907),
    ];
    for (name, values, tensors) in expected {
        let architecture = Architecture::named(name).unwrap();
        architecture.validate().unwrap();
        assert_eq!((architecture.parameter_count(), architecture.parameters().len()), (values, tensors), "{name}");
        let json = serde_json::to_string(&architecture).unwrap();
        assert_eq!(serde_json::from_str::<Architecture>(&json).unwrap(), architecture);
    }
    assert!(matches!(Architecture::named("vith"), Err(Error::Argument { .. })));
    let unaligned = Architecture { head_hidden: 302, ..golden("micro") };
    assert_refused(unaligned.validate(), &["head_hidden", "302", "a multiple of 8 up to 65536"]);
}

#[test]
fn architectures_that_are_no_network_are_refused() {
    let base = pico();
    let cases = [
        ("depth", Architecture { depth: 1 << 40, ..base.clone() }),
        ("width", Architecture { width: 0, ..base.clone() }),
        ("heads", Architecture { heads: 3, ..base.clone() }),
        ("heads", Architecture { heads: 8, ..base.clone() }),
        ("color_heads", Architecture { color_heads: 5, ..base.clone() }),
        ("alt_start", Architecture { alt_start: 2, ..base.clone() }),
        ("sh_degree", Architecture { sh_degree: 4, ..base.clone() }),
        ("out_layers", Architecture { out_layers: vec![], ..base.clone() }),
        ("out_layers", Architecture { out_layers: vec![1, 1], ..base.clone() }),
        ("out_layers", Architecture { out_layers: vec![2], ..base }),
    ];
    for (field, architecture) in cases {
        match Checkpoint::seeded_architecture(architecture, "key") {
            Err(Error::Argument { what, .. }) => assert!(what.starts_with(field), "{what}, expected {field}"),
            other => panic!("{field}: {other:?}"),
        }
    }
}

#[test]
fn seeded_values_are_those_of_the_reference() {
    let vectors = data("gen_vectors.json");
    let mut tensors = 0;
    for (config, parameters) in vectors["params"].as_object().unwrap() {
        let checkpoint = Checkpoint::seeded_architecture(golden(config), config).unwrap();
        for (name, expected) in parameters.as_object().unwrap() {
            assert_eq!(checkpoint.shape(name).unwrap(), shape(&expected["shape"]), "{config}/{name}");
            let values: Vec<f64> = read(&checkpoint, name).into_iter().map(f64::from).collect();
            let first: Vec<f64> =
                expected["first4"].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect();
            assert_eq!(values[..first.len()], first, "{config}/{name}");
            assert_eq!(values.last().copied(), expected["last"].as_f64(), "{config}/{name}");
            // Sums of multiples of 2^-20 below 2^30 are exact.
            let magnitudes = values.iter().map(|value| value.abs()).sum::<f64>();
            for (key, found) in [("sum", values.iter().sum()), ("abs_sum", magnitudes)] {
                let expected = expected[key].as_f64().unwrap();
                let error = f64::abs(found - expected);
                assert!(error <= f64::EPSILON * expected.abs(), "{config}/{name}: {key} {found}, expected {expected}");
            }
            tensors += 1;
        }
    }
    assert_eq!(tensors, 1340);
}

#[test]
fn micro_is_the_same_from_seed_safetensors_and_pytorch() {
    let seeded = Checkpoint::seeded_architecture(golden("micro"), "micro").unwrap();
    for name in ["micro.weights.safetensors", "micro.ckpt.tar"] {
        let Some(path) = shared(name) else { continue };
        let stored = Checkpoint::open_architecture(&path, golden("micro")).unwrap();
        assert_same_bits(&stored, &seeded);
        assert_eq!(stored.bytes(), seeded.bytes());

        let alone = Checkpoint::open(&path, None);
        if name.ends_with(".tar") {
            assert_eq!(alone.unwrap().architecture(), &golden("micro"));
        } else {
            let Err(Error::Argument { what, found, .. }) = alone else { panic!("{alone:?}") };
            assert_eq!(what, "variant");
            assert!(found.contains("width 64 and 3 blocks with 2 out layers"), "{found}");
        }
        let overridden = Checkpoint::open(&path, Some("out_layers=1,2")).unwrap();
        assert_eq!(Architecture { name: "micro".into(), ..overridden.architecture().clone() }, golden("micro"));
    }
}

#[test]
fn saved_checkpoints_state_their_architecture_and_keep_every_bit() {
    let folder = tempfile::tempdir().unwrap();
    let seeded = pico_weights();
    let values = pico().parameter_count() as u64;
    for (dtype, size) in [(Dtype::F32, 4), (Dtype::F16, 2), (Dtype::Bf16, 2)] {
        let (first, second) = (folder.path().join("first.safetensors"), folder.path().join("second.safetensors"));
        seeded.save(&first, dtype).unwrap();
        // Exact in all three types.
        convert(&first, &second, Dtype::F16, None).unwrap();
        for (path, size) in [(first, size), (second, 2)] {
            let stored = Checkpoint::open(&path, Some("pico")).unwrap();
            assert_eq!(stored.architecture(), &pico());
            assert_eq!(stored.bytes(), size * values);
            assert_eq!(stored.provenance(), path.display().to_string());
            assert_same_bits(&stored, &seeded);
            let file = std::fs::read(&path).unwrap();
            assert_eq!(u64::from_le_bytes(file[..8].try_into().unwrap()) % 8, 0);
            assert!(matches!(Checkpoint::open(&path, Some("vits")), Err(Error::Argument { .. })));
        }
    }
}

#[test]
fn files_without_metadata_are_recognised_by_size() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let vits = Architecture::named("vits").unwrap();
    let trained = Architecture {
        position_grid: 18,
        color_width: 64,
        color_heads: 1,
        color_hidden: 96,
        head_hidden: 2 * (384 + 64),
        ..vits.clone()
    };
    for expected in [vits, trained] {
        write_zeros(&path, &expected.parameters());
        assert_eq!(Checkpoint::open(&path, None).unwrap().architecture(), &expected);
        assert_eq!(Checkpoint::open(&path, Some("vits")).unwrap().architecture(), &expected);
        let Err(Error::Argument { found, expected, .. }) = Checkpoint::open(&path, Some("vitb")) else {
            panic!("vits is no vitb");
        };
        assert_eq!((found.as_str(), expected.contains("width 384 and 12 blocks")), ("vitb", true), "{expected}");
    }
}

#[test]
fn every_misfit_is_listed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let mut tensors = pico().parameters();
    let missing = tensors.remove(7).0;
    let (misshapen, shape) = tensors[20].clone();
    tensors[20].1.push(3);
    tensors.push(("module.extra".into(), vec![1]));
    write_zeros(&path, &tensors);
    let error = Checkpoint::open_architecture(&path, pico()).unwrap_err();
    let text = error.to_string();
    let Error::Weights { missing: a, unexpected: b, misshapen: c, .. } = error else { panic!("{text}") };
    assert_eq!((a, b), (vec![missing], vec!["extra".to_string()]));
    assert_eq!(c, [format!("{misshapen}: found {:?}, expected {shape:?}", tensors[20].1)]);
}

#[test]
fn reading_checks_name_length_and_values() {
    let checkpoint = pico_weights();
    assert!(matches!(checkpoint.read_f32("nothing", &mut []), Err(Error::Argument { .. })));
    assert!(matches!(checkpoint.shape("nothing"), Err(Error::Argument { .. })));
    let wrong_length = checkpoint.read_f32("backbone.backbone.norm.bias", &mut [0.0; 15]);
    assert!(matches!(wrong_length, Err(Error::Argument { .. })));

    let folder = tempfile::tempdir().unwrap();
    let (path, output) = (folder.path().join("weights.safetensors"), folder.path().join("output.safetensors"));
    std::fs::write(&output, "kept").unwrap();
    let last = "gaussian_head.gaussian_head.1.bias";
    for (value, dtype) in [(f32::NAN, Dtype::F32), (70_000.0, Dtype::F16), (f32::MAX, Dtype::Bf16)] {
        checkpoint.save(&path, Dtype::F32).unwrap();
        let mut file = std::fs::read(&path).unwrap();
        let end = file.len();
        file[end - 4..].copy_from_slice(&value.to_le_bytes());
        std::fs::write(&path, file).unwrap();
        match assert_refused(convert(&path, &output, dtype, None), &[last]) {
            Error::Format { .. } => assert!(value.is_nan()),
            Error::Argument { .. } => assert!(value.is_finite()),
            other => panic!("{other}"),
        }
    }
    assert_eq!(std::fs::read(&output).unwrap(), b"kept");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "a temporary file was left behind");
}

#[test]
fn texts_name_seeds_and_files() {
    let provenance = |text: &str| Checkpoint::parse(text, None).map(|checkpoint| checkpoint.provenance().to_string());
    assert_eq!(provenance("seeded:vits").unwrap(), "seeded:vits");
    assert_eq!(provenance("seeded:vits:small").unwrap(), "seeded:vits:small");
    assert!(matches!(provenance("seeded:vitx"), Err(Error::Argument { .. })));
    assert!(matches!(provenance("no/such/file"), Err(Error::Io { .. })));
    assert_eq!("bf16".parse::<Dtype>().unwrap(), Dtype::Bf16);
    assert!(matches!("f64".parse::<Dtype>(), Err(Error::Argument { .. })));

    let small = Checkpoint::parse("seeded:vits:small", None).unwrap();
    let same = Checkpoint::seeded_architecture(golden("small"), "small").unwrap();
    let name = "backbone.backbone.cls_token";
    assert_eq!(read(&small, name), read(&same, name));
    let distinct: HashMap<_, _> = small.tensor_names().map(|name| (name, ())).collect();
    assert_eq!(distinct.len(), 485);
}
