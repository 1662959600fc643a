use crate::calls::*;
use std::{ffi::CStr, fs};
use zipsplat::tune::SelfTest;
use zipsplat_c::{zs_precision::*, *};

fn precision_and_notes(device: &Object<zs_device>, precision: zs_precision) -> Result<(i32, String), zs_status> {
    let model = try_model_with(device, &zs_model_options { precision: precision as i32, ..Versioned::new() })?;
    let mut info = zs_model_info::new();
    let notes = unsafe {
        ok(zs_model_get_info(model.handle, &mut info));
        CStr::from_ptr(info.warnings)
    };
    Ok((info.precision, notes.to_str().expect("UTF-8").to_owned()))
}

#[test]
fn kernels_that_fail_their_test_are_named() {
    let cache = tempfile::tempdir().expect("a folder");
    let folder = c_string(cache.path().to_str().expect("UTF-8"));
    let options = zs_device_options { cache_dir: folder.as_ptr(), ..Versioned::new() };
    let device = made(try_device(&options));
    let fast = ZS_PRECISION_FP16 as i32;
    match precision_and_notes(&device, ZS_PRECISION_FP16) {
        Ok(found) => assert_eq!(found, (fast, String::new())),
        Err(_) => return eprintln!("not tested: {}", message()),
    }
    // Simulates failed kernels that fp16 can do without.
    let files: Vec<_> =
        fs::read_dir(cache.path().join("self-test")).unwrap().map(|file| file.unwrap().path()).collect();
    let [file] = &files[..] else { panic!("results of one test: {files:?}") };
    let mut known: serde_json::Value = serde_json::from_slice(&fs::read(file).unwrap()).unwrap();
    let mut test: SelfTest = serde_json::from_value(known["result"].clone()).unwrap();
    let failing = test.deviations.iter_mut().filter(|(kernel, _)| kernel.contains("matrix"));
    let failing: Vec<_> = failing.map(|(kernel, deviation)| (deviation.replace(9.0), kernel.clone()).1).collect();
    if failing.is_empty() {
        return eprintln!("not tested: without matrix units `fast` does without no kernel");
    }
    known["result"] = serde_json::to_value(&test).unwrap();
    fs::write(file, known.to_string()).unwrap();
    let (precision, notes) = made(precision_and_notes(&device, ZS_PRECISION_FP16));
    assert_eq!((precision, notes.lines().count()), (fast, failing.len()), "{notes}");
    for (note, kernel) in notes.lines().zip(&failing) {
        assert!(note.starts_with(&format!("{kernel} deviates 9.0 times")), "{note}");
    }
    let exact = made(precision_and_notes(&device, ZS_PRECISION_FP32));
    assert_eq!(exact, (ZS_PRECISION_FP32 as i32, String::new()));
}
