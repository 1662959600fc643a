//! Cancelling.

use crate::{Folder, Outcome, command, names};
use std::{
    fs::File,
    path::{Path, PathBuf},
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::channel,
    },
    time::Duration,
};
use zipsplat::{
    types::{read_scene, write_ply},
    weights::Checkpoint,
};
use zipsplat_tests::scenes;

#[test]
fn a_cancelled_command_leaves_no_file() {
    let folder = Folder::new();
    write_ply(&scenes::random_scene(50, 0, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let before = folder.names();
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --size 28x28 -o @/out.ply",
        "render @/scene.ply --wiggle -o @/out",
        "convert @/micro.safetensors @/out.safetensors",
        "bench render --gaussians 10",
    ] {
        command(&folder.line(line), &AtomicBool::new(true)).fails(130, &["cancelled"]);
        assert_eq!(folder.names(), before, "{line}");
    }
}

/// Cancelled after twice as long each time, until a command is done: at whatever it is by then.
#[test]
fn a_command_that_is_cancelled_on_its_way_leaves_whole_files_alone() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 28x28 -o @/place").success();
    write_ply(&scenes::random_scene(3000, 1, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    let made = folder.path("made");
    for line in [
        "reconstruct @/photos --weights @/micro.safetensors --size 28x28 -o @/made/scene.ply",
        "render @/scene.ply --wiggle --frames 24 --size 64x48 --video @/made/film.gif -o @/made/pictures",
        "convert @/micro.safetensors @/made/half.safetensors --dtype f16",
        "bench tradeoff @/place --weights @/micro.safetensors --size 28x28 --views 2 --ratio 1 --repeats 1 -o @/made",
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

/// What a command did that was cancelled so long after its start.
fn cancelled_after(delay: Duration, line: &str) -> Outcome {
    let (cancelled, (ended, end)) = (AtomicBool::new(false), channel::<()>());
    std::thread::scope(|scope| {
        let cancelled = &cancelled;
        scope.spawn(move || {
            // Ends early where the command does.
            let _ = end.recv_timeout(delay);
            cancelled.store(true, Ordering::Relaxed);
        });
        let outcome = command(line, cancelled);
        drop(ended);
        outcome
    })
}

/// Number of files in a folder and those below, each of which is a result and can be read to its end.
fn check_whole(folder: &Path) -> usize {
    let check = |path: &Path| match path.extension().and_then(|ext| ext.to_str()).unwrap_or_default() {
        "ply" => drop(read_scene(path).expect("a whole scene")),
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

/// Pictures of a GIF.
fn frames(path: &Path) -> usize {
    let file = File::open(path).expect("a file");
    let mut decoder = gif::DecodeOptions::new().read_info(file).expect("a GIF");
    std::iter::from_fn(|| decoder.read_next_frame().expect("a whole GIF").map(drop)).count()
}
