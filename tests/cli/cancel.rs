use crate::{Folder, Outcome, command, names};
use std::{
    fs::File,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};
use zipsplat::{types::Scene, weights::Checkpoint};
use zipsplat_cli::cancelled_by_signals;
use zipsplat_tests::processes::{child, target};

#[test]
fn a_cancelled_command_leaves_no_file() {
    let folder = Folder::new();
    folder.scatter("scene.ply", 50, 0, 0.1);
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

#[test]
fn a_command_that_is_cancelled_on_its_way_leaves_whole_files_alone() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    folder.scatter("scene.ply", 3000, 1, 0.1);
    let made = folder.path("made");
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/made/scene.ply",
        "render @/scene.ply --wiggle --frames 24 --size 64x48 --video @/made/film.gif -o @/made/pictures",
        "refine @/scene.ply @/place/images --cameras @/place --steps 12 -o @/made/scene.ply",
        "reconstruct @/place/images --cameras @/place --weights @/micro.safetensors --input-size 28x28 --refine=12 -o @/made/scene.ply",
        "convert @/micro.safetensors @/made/half.safetensors --dtype f16",
        "bench tradeoff @/place --weights @/micro.safetensors --input-size 28x28 --views 2 --ratio 1 --repeats 1 -o @/made",
    ] {
        folder.make("made");
        let finished = |outcome: &Outcome| {
            let count = check_whole(&made);
            std::fs::remove_dir_all(&made).expect("it was made above");
            folder.make("made");
            assert!(outcome.code != 0 || count > 0, "{line}");
            outcome.code == 0
        };
        cancelled_later(Duration::from_millis(1), &folder.line(line), finished);
    }
}

#[test]
fn a_sweep_that_is_cancelled_writes_what_it_measured() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    let line = folder.line(
        "bench tradeoff @/place --weights @/micro.safetensors --input-size 28x28 --views 1,2,3 --repeats 100 -o @/report",
    );
    let outcome = cancelled_later(Duration::from_millis(100), &line, |_| folder.path("report").exists());
    assert!(outcome.err.contains("points that were measured"), "{}", outcome.err);
    outcome.fails(130, &["cancelled"]);
    assert_eq!(check_whole(&folder.path("report")), 4);
}

#[test]
fn a_refinement_that_is_cancelled_writes_the_best_so_far() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    folder.scatter("scene.ply", 300, 1, 0.1);
    let shared = "@/place/images --cameras @/place -o @/best.ply";
    let reconstruct = format!("reconstruct {shared} --weights @/micro.safetensors --input-size 28x28");
    for line in [
        format!("refine @/scene.ply {shared} --steps 1000000"),
        format!("{reconstruct} --refine=1000000 --optimize-cameras --cameras-out @/cameras.json"),
        format!("{reconstruct} --refine=1000000 --refine-target tokens --world input-cameras"),
    ] {
        let is_written = |_: &Outcome| folder.path("best.ply").exists();
        let outcome = cancelled_later(Duration::from_millis(100), &folder.line(&line), is_written);
        assert!(outcome.err.contains("best.ply: the best so far, after step "), "{}", outcome.err);
        assert!(outcome.err.contains("; the same command continues"), "{}", outcome.err);
        Scene::open(folder.path("best.ply")).expect("a whole scene");
        assert_eq!(folder.path("cameras.json").exists(), !line.starts_with("refine @"), "{line}");
        outcome.fails(130, &["cancelled"]);
        folder.remove("best.ply");
        folder.remove("best.ply.checkpoint");
    }
}

/// Replaced scenes and COLMAP's cameras differ in each run, and converted photos are new files.
#[cfg(unix)]
#[test]
fn a_refinement_that_cannot_be_repeated_has_no_checkpoint() {
    use crate::cameras::{COPIES, OPTIONS_3, colmap, model};
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    let frames = folder.capture("place").frames;
    let names: Vec<String> = (0..frames.len()).map(|i| format!("0/{i:06}.png")).collect();
    let named: Vec<_> = names.iter().map(String::as_str).zip(frames.iter().map(|frame| &frame.camera)).collect();
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", COPIES]);
    model(&folder.path("colmap.model/0"), &named);
    folder.write("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0");
    folder.write("ppm", [b"P6\n16 8\n255\n".as_slice(), &[90; 3 * 16 * 8]].concat());
    let ppm = format!("cat '{}'", folder.line("@/ppm"));
    folder.script("ffmpeg", &format!("#!/bin/sh\ncase \"$*\" in *ppm*) {ppm};; esac\n"));
    let find = "--cameras colmap --colmap @/colmap -o @/best.ply";
    let micro = "--weights @/micro.safetensors --input-size 28x28 --refine=1000000";
    folder.scatter("best.ply", 300, 1, 0.1);
    for line in [
        "refine @/best.ply @/place/images --cameras @/place --steps 1000000 -o @/best.ply --overwrite".to_owned(),
        format!("refine @/place/images {find} --init points --steps 1000000"),
        format!("reconstruct @/place/images {find} {micro}"),
        format!("reconstruct @/place/images @/a.heic --ffmpeg @/ffmpeg --cameras @/place {micro} -o @/best.ply"),
    ] {
        let is_written = |outcome: &Outcome| outcome.err.contains("best.ply: the best so far, after step ");
        let outcome = cancelled_later(Duration::from_millis(100), &folder.line(&line), is_written);
        assert!(!outcome.err.contains("continues") && !folder.path("best.ply.checkpoint").exists(), "{line}");
        outcome.fails(130, &["cancelled"]);
        folder.remove("best.ply");
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

fn cancelled_later(mut delay: Duration, line: &str, done: impl Fn(&Outcome) -> bool) -> Outcome {
    loop {
        let outcome = cancelled_after(delay, line);
        if done(&outcome) {
            return outcome;
        }
        outcome.fails(130, &["cancelled"]);
        delay *= 2;
    }
}

fn cancelled_after(delay: Duration, line: &str) -> Outcome {
    let begin = Instant::now();
    cancelled_when(line, || begin.elapsed() >= delay)
}

pub fn cancelled_when(line: &str, ready: impl Fn() -> bool + Sync) -> Outcome {
    let (cancelled, ended) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !ended.load(Ordering::Relaxed) && !ready() {
                std::thread::sleep(Duration::from_micros(100));
            }
            cancelled.store(true, Ordering::Relaxed);
        });
        let outcome = command(line, &cancelled);
        ended.store(true, Ordering::Relaxed);
        outcome
    })
}

pub fn is_written(pid: &Path) -> bool {
    std::fs::read_to_string(pid).is_ok_and(|pid| pid.ends_with('\n'))
}

#[track_caller]
pub fn wait_until(child: &mut Child, ready: impl Fn() -> bool) {
    while !ready() {
        assert!(child.try_wait().expect("a child").is_none(), "it ended too early");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn check_whole(folder: &Path) -> usize {
    let check = |path: &Path| match path.extension().and_then(|ext| ext.to_str()).unwrap_or_default() {
        "ply" => drop(Scene::open(path).expect("a whole scene")),
        "png" => drop(image::open(path).expect("a whole picture")),
        "gif" => assert_eq!(frames(path), 24),
        "safetensors" => drop(Checkpoint::open(path, None).expect("whole weights")),
        "checkpoint" => assert!(std::fs::read(path).is_ok_and(|bytes| !bytes.is_empty())),
        "html" => assert!(std::fs::read_to_string(path).is_ok_and(|text| text.ends_with("</html>\n"))),
        "svg" => assert!(std::fs::read_to_string(path).is_ok_and(|text| text.ends_with("</svg>\n"))),
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

fn filming() -> (Folder, Child) {
    let folder = Folder::new();
    folder.scatter("scene.ply", 300, 0, 0.1);
    let mut child = started("cancel::draws_a_long_film", &folder);
    wait_until(&mut child, || hidden(&folder).is_some_and(|file| file.metadata().is_ok_and(|found| found.len() > 0)));
    (folder, child)
}

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
    wait_until(&mut child, || folder.path("ready").exists());
    send("-TERM", &child);
    send("-INT", &child);
    assert_eq!(child.wait().expect("it ends").code(), Some(130));
}

/// The command waits for the program's version.
#[test]
#[cfg(unix)]
fn a_second_signal_ends_the_programs_that_run() {
    use crate::colmap_ends::assert_ends;
    let folder = Folder::new();
    folder.script("sleeps", "#!/bin/sh\nsleep 60 & echo $! >\"$0.pid\"; wait\n");
    let pid = folder.path("sleeps.pid");
    let mut child = started("cancel::waits_for_another_program", &folder);
    wait_until(&mut child, || is_written(&pid));
    send("-TERM", &child);
    send("-INT", &child);
    // The first signal may have ended it in order.
    let code = child.wait().expect("it ends").code();
    assert!([Some(0), Some(130)].contains(&code), "{code:?}");
    assert_ends(&pid);
}
