//! Cancellation.

use crate::{Folder, Outcome, command, names};
use std::{
    fs::File,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::channel,
    },
    time::Duration,
};
use zipsplat::{
    types::{Scene, write_ply},
    weights::Checkpoint,
};
use zipsplat_cli::cancelled_by_signals;
use zipsplat_tests::{
    processes::{child, target},
    scenes,
};

#[test]
fn a_cancelled_command_leaves_no_file() {
    let folder = Folder::new();
    write_ply(&scenes::random_scene(50, 0, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let before = folder.names();
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/out.ply",
        "render @/scene.ply --wiggle -o @/out",
        "convert @/micro.safetensors @/out.safetensors",
        "bench render --gaussians 10",
    ] {
        command(&folder.line(line), &AtomicBool::new(true)).fails(130, &["cancelled"]);
        assert_eq!(folder.names(), before, "{line}");
    }
}

/// Doubles the delay until a command finishes.
#[test]
fn a_command_that_is_cancelled_on_its_way_leaves_whole_files_alone() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    write_ply(&scenes::random_scene(3000, 1, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let made = folder.path("made");
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/made/scene.ply",
        "render @/scene.ply --wiggle --frames 24 --size 64x48 --video @/made/film.gif -o @/made/pictures",
        "refine @/scene.ply @/place/images --cameras @/place --steps 12 -o @/made/scene.ply",
        "reconstruct @/place/images --cameras @/place --weights @/micro.safetensors --input-size 28x28 --refine=12 -o @/made/scene.ply",
        "convert @/micro.safetensors @/made/half.safetensors --dtype f16",
        "bench tradeoff @/place --weights @/micro.safetensors --input-size 28x28 --views 2 --ratio 1 --repeats 1 -o @/made",
    ] {
        let mut delay = Duration::from_millis(1);
        loop {
            std::fs::create_dir(&made).expect("an empty folder");
            let outcome = cancelled_after(delay, &folder.line(line));
            let count = check_whole(&made);
            std::fs::remove_dir_all(&made).expect("it was made above");
            if outcome.code == 0 {
                assert!(count > 0, "{line}");
                break;
            }
            outcome.fails(130, &["cancelled"]);
            delay *= 2;
        }
    }
}

/// Doubles the delay until something was measured.
#[test]
fn a_sweep_that_is_cancelled_writes_what_it_measured() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    let line = folder.line(
        "bench tradeoff @/place --weights @/micro.safetensors --input-size 28x28 --views 1,2,3 --repeats 100 -o @/report",
    );
    let mut delay = Duration::from_millis(100);
    let outcome = loop {
        let outcome = cancelled_after(delay, &line);
        if folder.path("report").exists() {
            break outcome;
        }
        outcome.fails(130, &["cancelled"]);
        delay *= 2;
    };
    assert!(outcome.err.contains("points that were measured"), "{}", outcome.err);
    outcome.fails(130, &["cancelled"]);
    assert_eq!(check_whole(&folder.path("report")), 2);
}

/// Doubles the delay until there is a result.
#[test]
fn a_refinement_that_is_cancelled_writes_the_best_so_far() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    write_ply(&scenes::random_scene(300, 1, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let shared = "@/place/images --cameras @/place -o @/best.ply";
    let reconstruct = format!("reconstruct {shared} --weights @/micro.safetensors --input-size 28x28");
    for line in [
        format!("refine @/scene.ply {shared} --steps 1000000"),
        format!("{reconstruct} --refine=1000000"),
        format!("{reconstruct} --refine=1000000 --refine-target tokens --world input-cameras"),
    ] {
        let mut delay = Duration::from_millis(100);
        let outcome = loop {
            let outcome = cancelled_after(delay, &folder.line(&line));
            if folder.path("best.ply").exists() {
                break outcome;
            }
            outcome.fails(130, &["cancelled"]);
            delay *= 2;
        };
        assert!(outcome.err.contains("best.ply: the best so far, after step "), "{}", outcome.err);
        Scene::open(folder.path("best.ply")).expect("a whole scene");
        outcome.fails(130, &["cancelled"]);
        std::fs::remove_file(folder.path("best.ply")).expect("it is there");
    }
}

#[test]
fn taking_photos_of_a_place_can_be_cancelled() {
    let folder = Folder::new();
    let before = folder.names();
    let line = folder.line("scene --seed 3 --views 16 --size 4096x4096 --supersample -o @/place");
    cancelled_after(Duration::from_millis(300), &line).fails(130, &["cancelled"]);
    assert_eq!(folder.names(), before);
}

fn cancelled_after(delay: Duration, line: &str) -> Outcome {
    let (cancelled, (ended, end)) = (AtomicBool::new(false), channel::<()>());
    std::thread::scope(|scope| {
        let cancelled = &cancelled;
        scope.spawn(move || {
            let _ = end.recv_timeout(delay);
            cancelled.store(true, Ordering::Relaxed);
        });
        let outcome = command(line, cancelled);
        drop(ended);
        outcome
    })
}

fn check_whole(folder: &Path) -> usize {
    let check = |path: &Path| match path.extension().and_then(|ext| ext.to_str()).unwrap_or_default() {
        "ply" => drop(Scene::open(path).expect("a whole scene")),
        "png" => drop(image::open(path).expect("a whole picture")),
        "gif" => assert_eq!(frames(path), 24),
        "safetensors" => drop(Checkpoint::open(path, None).expect("whole weights")),
        "html" => assert!(std::fs::read_to_string(path).is_ok_and(|text| text.ends_with("</html>\n"))),
        "csv" => {
            assert!(std::fs::read_to_string(path).is_ok_and(|text| text.lines().count() > 1 && text.ends_with('\n')))
        }
        _ => panic!("{} is no result", path.display()),
    };
    let paths = names(folder).into_iter().map(|name| folder.join(name));
    let count = |path: PathBuf| {
        if path.is_dir() {
            return check_whole(&path);
        }
        check(&path);
        1
    };
    paths.map(count).sum()
}

fn frames(path: &Path) -> usize {
    let file = File::open(path).expect("a file");
    let mut decoder = gif::DecodeOptions::new().read_info(file).expect("a GIF");
    std::iter::from_fn(|| decoder.read_next_frame().expect("a whole GIF").map(drop)).count()
}

#[test]
#[ignore = "child of the other tests"]
fn draws_a_long_film() {
    let Some(folder) = target() else { return };
    let line = "render @/scene.ply --wiggle --frames 100000 --size 64x48 --video @/film.gif";
    let line = line.replace('@', &folder.display().to_string());
    command(&line, cancelled_by_signals()).fails(130, &["cancelled"]);
}

#[test]
#[ignore = "child of the other tests"]
fn waits_for_another_program() {
    let Some(folder) = target() else { return };
    let line = "cameras @/photos --colmap @/sleeps -o @/transforms.json";
    let outcome = command(&line.replace('@', &folder.display().to_string()), cancelled_by_signals());
    outcome.fails(130, &["cancelled"]);
}

#[test]
#[ignore = "child of the other tests"]
fn ignores_that_it_should_end() {
    let Some(folder) = target() else { return };
    cancelled_by_signals();
    std::fs::write(folder.join("ready"), "").expect("a file");
    std::thread::sleep(Duration::from_secs(60));
}

/// A video is partially written on return.
fn filming() -> (Folder, Child) {
    let folder = Folder::new();
    write_ply(&scenes::random_scene(300, 0, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let mut child = started("cancel::draws_a_long_film", &folder);
    while !hidden(&folder).is_some_and(|file| file.metadata().is_ok_and(|found| found.len() > 0)) {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before it wrote anything");
        std::thread::sleep(Duration::from_millis(5));
    }
    (folder, child)
}

/// With default signal handlers.
fn started(name: &str, folder: &Folder) -> Child {
    child(name, &folder.path(""), "set -- env --default-signal \"$@\"").spawn().expect("bash")
}

fn hidden(folder: &Folder) -> Option<PathBuf> {
    folder.names().iter().find(|name| name.starts_with('.')).map(|name| folder.path(name))
}

fn send(signal: &str, child: &Child) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("kill").success());
}

#[test]
fn a_command_that_is_asked_to_end_leaves_no_file() {
    for signal in ["-TERM", "-HUP", "-INT"] {
        let (folder, child) = filming();
        send(signal, &child);
        let out = child.wait_with_output().expect("it ends");
        let text = String::from_utf8_lossy(&out.stdout);
        assert!(out.status.success() && text.contains("1 passed"), "{signal}: {text}");
        assert_eq!(folder.names(), ["micro.safetensors", "photos", "scene.ply"], "{signal}");
    }
}

#[test]
fn a_second_signal_ends_at_once() {
    let folder = Folder::new();
    let mut child = started("cancel::ignores_that_it_should_end", &folder);
    while !folder.path("ready").exists() {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before it was ready");
        std::thread::sleep(Duration::from_millis(5));
    }
    send("-TERM", &child);
    send("-INT", &child);
    assert_eq!(child.wait().expect("it ends").code(), Some(130));
}

/// The command waits for the program's version.
#[test]
#[cfg(unix)]
fn a_second_signal_ends_the_programs_that_run() {
    use crate::{cameras::script, colmap_ends::assert_ends};
    let folder = Folder::new();
    script(&folder, "sleeps", "#!/bin/sh\nsleep 60 & echo $! >\"$0.pid\"; wait\n");
    let pid = folder.path("sleeps.pid");
    let mut child = started("cancel::waits_for_another_program", &folder);
    // Completely written.
    while !std::fs::read_to_string(&pid).is_ok_and(|pid| pid.ends_with('\n')) {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before it ran the program");
        std::thread::sleep(Duration::from_millis(5));
    }
    send("-TERM", &child);
    send("-INT", &child);
    // The first signal may have ended it in order before the second one came.
    let code = child.wait().expect("it ends").code();
    assert!([Some(0), Some(130)].contains(&code), "{code:?}");
    assert_ends(&pid);
}
