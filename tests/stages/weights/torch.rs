use super::{assert_same_bits, malformed::assert_reason, pico, pico_weights, read};
use zip::CompressionMethod;
use zipsplat::weights::convert;
use zipsplat_tests::{pickles::*, prelude::*};

fn model(tensors: &[(&str, Vec<u8>)]) -> Vec<u8> {
    [b"\x80\x02".to_vec(), dict(&[("model", dict(tensors))]), b".".to_vec()].concat()
}

/// Layouts of released checkpoints.
#[test]
fn all_layouts_are_read() {
    let seeded = pico_weights();
    let (mut tensors, mut storages) = (Vec::new(), Vec::new());
    for (i, (name, shape)) in seeded.parameters().iter().enumerate() {
        let (key, mut values, elements) = (i.to_string(), read(&seeded, name), shape.iter().product());
        let (mut strides, mut offset) = (row_major(shape), 0);
        if i % 2 == 0 && shape.len() == 2 {
            // Transposed in memory.
            let source = values.clone();
            let (rows, columns) = (shape[0], shape[1]);
            values = (0..elements).map(|at| source[at % rows * columns + at / rows]).collect();
            strides = vec![1, rows];
        }
        if i % 3 == 0 {
            // A slice of a longer storage.
            offset = 5;
            values = [vec![f32::NAN; 5], values, vec![f32::NAN; 2]].concat();
        }
        let (kind, bytes): (&str, Vec<u8>) = match i % 5 {
            0 => ("HalfStorage", values.iter().flat_map(|&v| half::f16::from_f32(v).to_le_bytes()).collect()),
            1 => ("BFloat16Storage", values.iter().flat_map(|&v| half::bf16::from_f32(v).to_le_bytes()).collect()),
            _ => ("FloatStorage", values.iter().flat_map(|v| v.to_le_bytes()).collect()),
        };
        let view = View { kind, key: &key, elements: values.len(), offset, shape, strides: &strides };
        let mut pickle = view.pickle();
        if i % 7 == 0 {
            pickle = call("torch._utils", "_rebuild_parameter", &[pickle, b"\x88".to_vec(), b"}".to_vec()]);
        }
        tensors.push((format!("module.{name}"), pickle));
        storages.push((format!("data/{key}"), bytes));
    }
    // With attributes, as of `Module.state_dict`.
    let named: Vec<_> = tensors.iter().map(|(name, pickle)| (name.as_str(), pickle.clone())).collect();
    let items = dict(&named).split_off(1);
    let attributes = dict(&[("_metadata", dict(&[("version", int(1))]))]);
    let ordered = [global("collections", "OrderedDict"), b")Rq\x01".to_vec(), items, attributes, b"b".to_vec()];
    let floats = [b"]q\x02(G".as_slice(), &1.5f64.to_be_bytes(), b"N\x8a\x02\x00\x80\x8a\x00e"].concat();
    let root = dict(&[("epoch", int(3)), ("losses", floats), ("model", ordered.concat()), ("best", b"h\x02".to_vec())]);
    let pickle = [b"\x80\x02".to_vec(), root, b".".to_vec()].concat();

    let mut entries = vec![("data.pkl", pickle.as_slice()), ("byteorder", b"little")];
    entries.extend(storages.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())));
    let folder = tempfile::tempdir().unwrap();
    let (path, converted) = (folder.path().join("pico.tar"), folder.path().join("pico.safetensors"));
    std::fs::write(&path, archive(&entries, CompressionMethod::Stored)).unwrap();
    let opened = Checkpoint::open_architecture(&path, pico()).unwrap();
    assert_same_bits(&opened, &seeded);
    opened.save(&converted, Dtype::Bf16).unwrap();
    convert(&converted, &converted, Dtype::F32, None).unwrap();
    assert_same_bits(&Checkpoint::open(&converted, None).unwrap(), &seeded);
}

#[test]
fn nothing_is_executed() {
    let argument = tuple(&[text("touch here")]);
    let stack_global = [text("posix"), text("system"), b"\x93".to_vec()].concat();
    let cases = [
        ("os.system", [global("os", "system"), argument.clone(), b"R.".to_vec()].concat()),
        ("posix.system", [b"\x80\x04".to_vec(), stack_global, argument.clone(), b"R.".to_vec()].concat()),
        ("os.popen", [b"(".to_vec(), text("touch here"), b"ios\npopen\n.".to_vec()].concat()),
        ("builtins.eval", [b"}".to_vec(), global("builtins", "eval"), b"0.".to_vec()].concat()),
        ("torch.load", model(&[("a", global("torch", "load"))])),
        ("torch._utils._rebuild_tensor", model(&[("a", global("torch._utils", "_rebuild_tensor"))])),
    ];
    for (name, pickle) in cases {
        assert_reason(&pickled(&pickle), &format!("asks for {name};"));
    }
}

#[test]
fn pickles_that_are_not_sound() {
    let cases: [(&str, &[u8]); 16] = [
        ("ends", b""),
        ("ends", b"\x80\x02}"),
        ("ends", b"X\xff\xff\xff\xffabc"),
        ("ends", b"\x8d\xff\xff\xff\xff\xff\xff\xff\xffabc"),
        ("ends within a name", b"cos"),
        ("text", b"X\x02\x00\x00\x00\xff\xff."),
        ("stack is empty", b"."),
        ("stack is empty", b"}(."),
        ("no mark", b"}u."),
        ("memo has no entry 9", b"h\x09."),
        ("no list", b"}Na."),
        ("no dictionary", b"](NNu."),
        ("no dictionary", b"}(NNNu."),
        ("no storage", b"NQ."),
        ("cannot be called", b"})R."),
        ("no dictionary `model`", b"]."),
    ];
    for (expected, pickle) in cases {
        assert_reason(&pickled(pickle), expected);
    }
    for opcode in [b'0', b'o', 0x81, 0x82, 0x92, 0x96, 0xff] {
        assert_reason(&pickled(&[b'}', opcode, b'.']), "pickle opcode");
    }
    assert_reason(&pickled(&vec![b'N'; 1 << 25]), "expected at most");
    // The later value counts.
    let twice = dict(&[("model", dict(&[("a", b"N".to_vec())])), ("model", b"]".to_vec())]);
    assert_reason(&pickled(&[twice.as_slice(), b"."].concat()), "no dictionary `model`");
    // Objects, references, marks, stack and memo entries count.
    for many in [b")".as_slice(), b"]", b"}", b"N", b"(", b"N\x94", b"N\x85", b"]\x94h\x00a", b"](NNNNNNNNe"] {
        assert_reason(&pickled(&many.repeat(1 << 20)), "more than 1048576 objects");
    }
    // Cycles and doubling cost no more than their bytes.
    let doubling = [b"]q\x00h\x00a".as_slice(), &b"q\x01h\x01h\x01\x86".repeat(1000), b"."].concat();
    assert_reason(&pickled(&doubling), "no dictionary `model`");
}

#[test]
fn tensors_beyond_their_storage() {
    let whole = View { kind: "FloatStorage", key: "0", elements: 6, offset: 0, shape: &[2, 3], strides: &[3, 1] };
    let huge = 1 << 30;
    let cases = [
        ("strides", View { offset: 1, ..whole }),
        ("strides", View { strides: &[4, 1], ..whole }),
        ("strides", View { shape: &[3, 3], ..whole }),
        ("strides", View { shape: &[6], ..whole }),
        ("strides", View { shape: &[huge; 8], strides: &[huge; 8], ..whole }),
        ("strides", View { shape: &[huge; 8], strides: &[0; 8], ..whole }),
        ("no size", View { shape: &[1; 9], strides: &[1; 9], ..whole }),
        ("no size", View { offset: usize::MAX, ..whole }),
        ("found 24 bytes, expected 7 f32", View { elements: 7, ..whole }),
        ("found 24 bytes, expected 6 f16", View { kind: "HalfStorage", ..whole }),
        ("torch.LongStorage", View { kind: "LongStorage", ..whole }),
        ("data/9", View { key: "9", ..whole }),
    ];
    let pickles = cases.map(|(expected, view)| (expected, view.pickle()));
    let tensor = whole.pickle();
    let at = tensor.windows(6).position(|bytes| bytes == [b"Q".as_slice(), &int(0)].concat()).unwrap() + 1;
    let minus_one = [&tensor[..at], b"\x8a\x01\xff", &tensor[at + 5..]].concat();
    for (expected, pickle) in pickles.into_iter().chain([("no size", minus_one)]) {
        let pickle = model(&[("a", pickle)]);
        let entries = [("data.pkl", pickle.as_slice()), ("data/0", &[0; 24])];
        assert_reason(&archive(&entries, CompressionMethod::Stored), expected);
    }
}

#[test]
fn archives_that_are_damaged() {
    let view = View { kind: "FloatStorage", key: "0", elements: 64, offset: 0, shape: &[64], strides: &[1] };
    let pickle = model(&[("a", view.pickle())]);
    let entries = [("data.pkl", pickle.as_slice()), ("byteorder", b"little"), ("data/0", &[7; 256])];
    let whole = archive(&entries, CompressionMethod::Stored);
    for length in [4, 100, whole.len() / 2, whole.len() - 30] {
        assert_reason(&whole[..length], "zip archive");
    }
    let mut flipped = whole.clone();
    let value = flipped.windows(256).position(|bytes| bytes == [7; 256]).unwrap();
    flipped[value] = 8;
    assert_reason(&flipped, "checksum");
    assert_reason(&archive(&entries, CompressionMethod::Deflated), "found compression");

    let big = [("data.pkl", pickle.as_slice()), ("byteorder", b"big"), ("data/0", &[7; 256])];
    assert_reason(&archive(&big, CompressionMethod::Stored), "byteorder: found \"big\"");
    assert_reason(&archive(&entries[1..], CompressionMethod::Stored), "no entry data.pkl");
    let twice = model(&[("a", view.pickle()), ("module.a", view.pickle())]);
    let entries = [("data.pkl", twice.as_slice()), ("data/0", &[7; 256])];
    assert_reason(&archive(&entries, CompressionMethod::Stored), "found twice");
    assert_reason(&pickled(&model(&[("a", b"N".to_vec())])), "no named tensor");
}

/// Checking the bytes of each entry would be quadratic.
#[test]
fn entries_that_share_bytes() {
    let keys: Vec<String> = (0..8).map(|i| format!("data/{i}")).collect();
    let view = View { kind: "FloatStorage", key: "", elements: 4096, offset: 0, shape: &[4096], strides: &[1] };
    let tensors: Vec<_> = keys.iter().map(|key| (key.as_str(), View { key: &key[5..], ..view }.pickle())).collect();
    let pickle = model(&tensors);
    let values = [7; 4 * 4096];
    let mut entries = vec![("data.pkl", pickle.as_slice()), ("data/0", &values)];
    entries.extend(keys[1..].iter().map(|key| (key.as_str(), [].as_slice())));
    let mut file = archive(&entries, CompressionMethod::Stored);
    // Checksum and sizes at 16, entry offset at 42.
    let records: Vec<usize> = (0..file.len()).filter(|&at| file[at..].starts_with(b"PK\x01\x02")).collect();
    assert_eq!(records.len(), 9);
    for &record in &records[2..] {
        for field in [16..28, 42..46] {
            let from = records[1] + field.start..records[1] + field.end;
            file.copy_within(from, record + field.start);
        }
    }
    assert_reason(&file, "into other entries");
}
