use super::{header, pico, pico_weights};
use zipsplat_tests::prelude::*;

fn file(json: &str, values: usize) -> Vec<u8> {
    [&(json.len() as u64).to_le_bytes(), json.as_bytes(), &vec![0; values]].concat()
}

#[track_caller]
pub fn assert_reason(bytes: &[u8], expected: &str) {
    assert_malformed("bad", bytes, |path| Checkpoint::open_architecture(path, pico()), &[expected]);
}

#[test]
fn truncated_anywhere() {
    let whole = bytes_of("weights.safetensors", |path| pico_weights().save(path, Dtype::F16).unwrap());
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    for length in [0, 1, 7, 8, 9, header - 1, header, header + 1, whole.len() / 2, whole.len() - 1] {
        assert_reason(&whole[..length], "");
    }
    assert_reason(&[whole.as_slice(), &[0]].concat(), "bytes of values");
}

#[test]
fn lying_headers() {
    assert_reason(&[0xff; 64], "a safetensors header of 18446744073709551615 bytes");
    assert_reason(&file("{}", 0)[..9], "a safetensors header of 2 bytes");
    assert_reason(&file("[1, 2]", 0), "safetensors header");
    assert_reason(&file("{\"a\"", 0), "safetensors header");

    let entry = |name: &str, dtype: &str, shape: &str, offsets: &str| {
        format!("\"{name}\":{{\"dtype\":\"{dtype}\",\"shape\":{shape},\"data_offsets\":{offsets}}}")
    };
    let one = |dtype, shape, offsets| format!("{{{}}}", entry("a", dtype, shape, offsets));
    let two = |first, second| format!("{{{},{}}}", entry("a", "F32", "[2]", first), entry("b", "F32", "[2]", second));
    assert_reason(&file(&two("[0,8]", "[4,12]"), 12), "safetensors header");
    assert_reason(&file(&two("[0,8]", "[0,8]"), 8), "safetensors header");
    assert_reason(&file(&two("[0,8]", "[12,20]"), 20), "safetensors header");
    assert_reason(&file(&one("F32", "[2]", "[8,0]"), 8), "safetensors header");
    assert_reason(&file(&one("F32", "[3]", "[0,8]"), 8), "safetensors header");
    assert_reason(&file(&one("F32", "[2]", "[0,8]"), 4), "found 4 bytes of values, the header expects 8");
    assert_reason(&file(&one("F32", "[4294967296,4294967296]", "[0,0]"), 0), "safetensors header");
    assert_reason(&file(&one("U8", "[18446744073709551535]", "[0,18446744073709551535]"), 0), "safetensors header");
    assert_reason(&file(&one("I64", "[1]", "[0,8]"), 8), "a: found type I64, expected F64, F32, F16 or BF16");
    assert_reason(&file(&two("[0,8]", "[8,16]").replace("\"b\"", "\"module.a\""), 16), "found twice");
}

/// Strides must not take quadratic time.
#[test]
fn tensors_of_very_many_axes() {
    let shape = vec!["1"; 1_000_000].join(",");
    let json = format!("{{\"a\":{{\"dtype\":\"F32\",\"shape\":[{shape}],\"data_offsets\":[0,4]}}}}");
    assert_reason(&file(&json, 4), "a: found 1000000 axes, expected at most 8");
}

#[test]
fn metadata_that_is_unusable() {
    let with = |key: &str, value: &str| {
        let quoted = serde_json::to_string(value).unwrap();
        file(&format!("{{\"__metadata__\":{{\"zipsplat.{key}\":{quoted}}}}}"), 0)
    };
    let with_metadata = |architecture: &str| with("architecture", architecture);
    assert_reason(&with("format_version", "2"), "zipsplat.format_version: found 2, expected at most 1");
    assert_reason(&with("image_size", "15"), "zipsplat.image_size: found 15");
    assert_reason(&with("picture_side", "15"), "zipsplat.image_size: found 15");
    assert_reason(&with_metadata("vits"), "zipsplat.architecture");
    let json = serde_json::to_string(&pico()).unwrap();
    assert_reason(&with_metadata(&json.replace("\"depth\":2", "\"depth\":99999999999")), "depth of pico");
    assert_reason(&with_metadata(&json.replace("\"depth\"", "\"length\"")), "unknown field `length`");
}

#[test]
fn neither_format() {
    let (header, _) = header(&pico().parameters());
    assert_reason(&header, "bytes of values");
    for other in [b"version https://git-lfs.github.com/spec/v1\n".as_slice(), b"<!DOCTYPE html>", b"no"] {
        assert_reason(other, "expected safetensors or a zip archive of torch.save");
    }
    assert_reason(b"PK\x03\x04 and no more", "zip archive");
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Checkpoint::open(folder.path(), None), Err(Error::Argument { .. })));
    assert!(matches!(Checkpoint::open(Path::new("no/such/file"), None), Err(Error::Io { .. })));
}
