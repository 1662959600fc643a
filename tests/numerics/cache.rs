use std::time::{Duration, SystemTime};
use tempfile::TempDir;
use zipsplat::tune::{KernelChoice, SelfTest};
use zipsplat_tests::prelude::*;

/// Computes in f16 with this cache: `passed`, `noted` failed kernels, `refused`, or `stopped`.
fn process(cache: &Path, expected: &str) -> std::process::Command {
    let mut command = child("cache::computes_in_f16", Path::new(expected), "");
    command.env("ZIPSPLAT_CACHE", cache).env("ZIPSPLAT_VALIDATION", "0");
    command
}

#[test]
#[ignore = "child of the other tests"]
fn computes_in_f16() {
    let Some(expected) = target() else { return };
    if expected == Path::new("stopped") {
        let stopped = KernelChoice::of_with(device(), Some(Precision::Fp16), |_, _| ControlFlow::Break(()));
        return assert!(matches!(stopped, Err(Error::Cancelled)), "{stopped:?}");
    }
    match KernelChoice::of(device(), Some(Precision::Fp16)) {
        Ok(chosen) => {
            assert_eq!(chosen.arithmetic.element, Element::F16);
            assert_eq!(
                expected,
                Path::new(if chosen.warnings.is_empty() { "passed" } else { "noted" }),
                "{:?}",
                chosen.warnings
            );
        }
        Err(error) => {
            assert!(matches!(error, Error::Argument { .. }) && expected == Path::new("refused"), "{error}");
            assert!(error.to_string().contains("remove "), "{error}");
        }
    }
}

/// `None` without f16.
fn folder() -> Option<TempDir> {
    device().limits().half_storage.then(|| tempfile::tempdir().unwrap())
}

/// Folder, file and contents of a good result.
fn cache() -> Option<(TempDir, PathBuf, Vec<u8>)> {
    let folder = folder()?;
    assert_succeeds(process(folder.path(), "passed"));
    let mut files = fs::read_dir(folder.path().join("self-test")).unwrap();
    let file = files.next().expect("the result is kept").unwrap().path();
    assert!(files.next().is_none(), "only that");
    let result = fs::read(&file).unwrap();
    Some((folder, file, result))
}

fn parsed(bytes: &[u8]) -> SelfTest {
    let known: serde_json::Value = serde_json::from_slice(bytes).expect("what is known");
    serde_json::from_value(known["result"].clone()).expect("a result")
}

#[test]
fn a_damaged_result_is_found_anew() {
    let Some((folder, file, good)) = cache() else { return };
    let empty = br#"{"begun":0,"result":{"deviations":{}}}"#;
    for damaged in [&b""[..], &good[..good.len() / 2], b"{}", b"\xff\x00", b"[1e999]", empty] {
        fs::write(&file, damaged).unwrap();
        assert_succeeds(process(folder.path(), "passed"));
        assert_eq!(parsed(&fs::read(&file).unwrap()), parsed(&good), "after {:?}", String::from_utf8_lossy(damaged));
    }
    fs::remove_file(&file).unwrap();
    fs::create_dir(&file).unwrap();
    assert_succeeds(process(folder.path(), "passed"));
    assert!(file.is_dir());
}

#[test]
fn a_test_that_a_lost_device_ended_goes_on_with_the_other_kernels() {
    if device().limits().matrices.f16.is_none() {
        return;
    }
    let Some((folder, file, good)) = cache() else { return };
    let all = parsed(&good);
    assert!(
        all.deviations.keys().all(|kernel| !kernel.contains("bf16") && !kernel.contains("i8")),
        "only what is used"
    );
    // Device loss in a group's first kernel on matrix units: fp16 does without.
    let mut begun = all.clone();
    begun.deviations.retain(|kernel, _| kernel == "ops/linear_f16_f32");
    begun.deviations.insert("ops/linear_matrix_f16_f32".into(), None);
    let known = serde_json::json!({ "begun": 0, "result": begun });
    fs::write(&file, known.to_string()).unwrap();
    assert_succeeds(process(folder.path(), "noted"));
    let mut expected = all;
    expected.deviations.insert("ops/linear_matrix_f16_f32".into(), None);
    assert_eq!(parsed(&fs::read(&file).unwrap()), expected, "all others are tested, and it is not tried again");
}

#[test]
fn a_test_that_is_stopped_was_not_begun() {
    let Some((folder, file, good)) = cache() else { return };
    fs::remove_file(&file).unwrap();
    for _ in 0..3 {
        assert_succeeds(process(folder.path(), "stopped"));
    }
    assert_succeeds(process(folder.path(), "passed"));
    assert_eq!(parsed(&fs::read(&file).unwrap()), parsed(&good));
}

#[test]
fn folders_that_cannot_be_written_to() {
    let Some(folder) = folder() else { return };
    let (taken, locked) = (folder.path().join("taken"), folder.path().join("locked"));
    fs::write(&taken, "a file").unwrap();
    fs::create_dir(&locked).unwrap();
    let mut permissions = locked.metadata().unwrap().permissions();
    permissions.set_readonly(true);
    fs::set_permissions(&locked, permissions).unwrap();
    // Root can write everywhere except /proc.
    for cache in [&taken, &locked, Path::new("/proc/nothing")] {
        assert_succeeds(process(cache, "passed"));
    }
    for home in [Some("/no/such/home"), Some(""), None] {
        let mut process = process(Path::new(""), "passed");
        ["ZIPSPLAT_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA", "HOME"].iter().for_each(|name| {
            process.env_remove(name);
        });
        process.envs(home.map(|home| ("HOME", home))).current_dir(folder.path());
        assert_succeeds(process);
    }
    assert_eq!(fs::read(&taken).unwrap(), b"a file");
    assert_eq!(folder.path().read_dir().unwrap().count(), 2, "something was put into the current folder");
}

#[test]
fn processes_at_once_leave_one_result() {
    let Some(folder) = folder() else { return };
    let processes = [0; 3].map(|_| process(folder.path(), "passed").spawn().unwrap());
    for process in processes {
        let out = process.wait_with_output().unwrap();
        // Work in progress is no failure.
        assert!(
            out.status.success(),
            "{}{}",
            String::from_utf8_lossy(&out.stdout),
            String::from_utf8_lossy(&out.stderr)
        );
    }
    let files: Vec<_> =
        fs::read_dir(folder.path().join("self-test")).unwrap().map(|file| file.unwrap().path()).collect();
    assert_eq!(files.len(), 1, "{files:?}");
    assert!(parsed(&fs::read(&files[0]).unwrap()).deviations.len() > 1);
}

#[test]
fn a_test_that_never_ended_is_tried_once_more() {
    let Some((folder, file, good)) = cache() else { return };
    let write = |begun: u32, age: Duration| {
        let known = format!(r#"{{"begun":{begun},"result":null}}"#);
        fs::write(&file, &known).unwrap();
        fs::File::options().write(true).open(&file).unwrap().set_modified(SystemTime::now() - age).unwrap();
        known
    };
    let hour = Duration::from_secs(3600);
    // Aborted, and in progress in another process.
    for (begun, age) in [(1, hour), (2, Duration::ZERO)] {
        write(begun, age);
        assert_succeeds(process(folder.path(), "passed"));
        assert_eq!(parsed(&fs::read(&file).unwrap()), parsed(&good));
    }
    let known = write(2, hour);
    assert_succeeds(process(folder.path(), "refused"));
    assert_eq!(fs::read_to_string(&file).unwrap(), known);
}
