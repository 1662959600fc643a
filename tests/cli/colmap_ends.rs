#![cfg(unix)]

use crate::{
    cameras::{COPIES, OPTIONS_3, colmap, place},
    cancel::{cancelled_when, is_written, wait_until},
    zipsplat,
};
use std::{fs, path::Path};
use zipsplat_tests::processes::{assert_succeeds, child, target};

pub fn assert_ends(pid: &Path) {
    let pid = fs::read_to_string(pid).expect("a number");
    // Otherwise it sleeps for a minute.
    let begin = std::time::Instant::now();
    loop {
        let state = fs::read_to_string(format!("/proc/{}/stat", pid.trim())).unwrap_or_default();
        if state.is_empty() || state.contains(") Z ") {
            break;
        }
        assert!(begin.elapsed().as_secs() < 30, "still there: {state}");
        std::thread::yield_now();
    }
}

#[test]
fn ctrl_c_ends_all_of_colmaps_processes() {
    let (folder, _) = place();
    colmap(&folder, "sleeps", "3.8", OPTIONS_3, ["sleep 60 & echo $! >\"$0.pid\"; wait", "", COPIES]);
    let (line, pid) = ("cameras @/place/images --colmap @/sleeps -o @/transforms.json", folder.path("sleeps.pid"));
    cancelled_when(&folder.line(line), || is_written(&pid)).fails(130, &["cancelled"]);
    assert_ends(&pid);
    assert!(!folder.path("transforms.json").exists() && !folder.path("colmap.log").exists());
}

#[test]
fn a_kill_ends_all_of_colmaps_processes_too() {
    let (folder, _) = place();
    colmap(&folder, "sleeps", "3.8", OPTIONS_3, ["sleep 60 & echo $! >\"$0.pid\"; wait", "", COPIES]);
    let pid = folder.path("sleeps.pid");
    let temporary = folder.path("temporary");
    fs::create_dir(&temporary).expect("a folder");
    fs::rename(folder.path("place/images"), folder.path("images")).expect("photos");
    let run = |name: &str| {
        let mut process = child(name, &folder.path(""), "set -- env --default-signal \"$@\"");
        process.env("TMPDIR", &temporary);
        process
    };
    let mut started = run("colmap_ends::waits_for_colmap").spawn().expect("bash");
    wait_until(&mut started, || is_written(&pid));
    started.kill().expect("it runs");
    started.wait().expect("it ends");
    assert_ends(&pid);
    assert!(crate::names(&temporary).iter().any(|name| name.starts_with(".zipsplat-scratch-")));
    colmap(&folder, "sleeps", "3.8", OPTIONS_3, ["exit 1", "", COPIES]);
    assert_succeeds(run("colmap_ends::waits_for_colmap"));
    assert!(!crate::names(&temporary).iter().any(|name| name.starts_with(".zipsplat-scratch-")));
}

#[test]
#[ignore = "child of the other tests"]
fn waits_for_colmap() {
    let Some(folder) = target() else { return };
    let line = format!("cameras {0}/images --colmap {0}/sleeps -o {0}/transforms.json", folder.display());
    zipsplat(&line).fails(1, &["could not find features"]);
}

#[test]
fn ctrl_c_ends_a_question_for_help() {
    let (folder, _) = place();
    folder.script("slow", "#!/bin/sh\necho $$ >\"$0.pid\"\nsleep 60\n");
    let (line, pid) = ("cameras @/place/images --colmap @/slow -o @/transforms.json", folder.path("slow.pid"));
    cancelled_when(&folder.line(line), || is_written(&pid)).fails(130, &["cancelled"]);
    assert_ends(&pid);
}
