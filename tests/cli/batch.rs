use crate::{Folder, Outcome, command, photo};
use serde_json::Value;
use std::{path::Path, sync::atomic::AtomicBool, time::SystemTime};

const WEIGHTS: &str = "--weights @/micro.safetensors --input-size 28x28";

/// `all/1`, `all/2` (photos in `images`) and `all/10`.
fn captures() -> Folder {
    let folder = Folder::new();
    for (i, place) in ["all/1", "all/2/images", "all/10"].into_iter().enumerate() {
        folder.make(place);
        for view in 0..2 {
            let name = folder.path(place).join(format!("{view}.png"));
            photo(40, 30, (10 * i + view) as u32).save_png(name).expect("a photo can be written");
        }
    }
    folder.write("all/notes.txt", "no capture");
    folder.make("all/empty");
    folder
}

fn batch(folder: &Folder, line: &str) -> Outcome {
    folder.run(&format!("--json reconstruct --each {WEIGHTS} {line}"))
}

fn numbers(outcome: Outcome) -> [u64; 4] {
    let envelope: Value = serde_json::from_str(&outcome.out).unwrap_or_else(|_| panic!("{}", outcome.err));
    let report = &envelope["result"];
    ["reconstructed", "skipped", "failed", "remaining"].map(|name| report[name].as_u64().expect("a number"))
}

fn times(folder: &Folder, names: &[&str]) -> Vec<SystemTime> {
    names.iter().map(|name| folder.path(name).metadata().expect("a file").modified().expect("a time")).collect()
}

#[test]
fn makes_the_scenes_of_reconstruct() {
    let folder = captures();
    let report = batch(&folder, "@/all -o @/out --ratio 0.5").json();
    assert!(report["captures_per_second"].as_f64().is_some_and(|rate| rate > 0.0));
    assert_eq!((&report["captures"], &report["reconstructed"]), (&3.into(), &3.into()));
    assert_eq!(super::names(&folder.path("out")), ["1.json", "1.ply", "10.json", "10.ply", "2.json", "2.ply"]);
    for (name, photos) in [("1", "all/1"), ("2", "all/2/images"), ("10", "all/10")] {
        folder.run(&format!("reconstruct {WEIGHTS} @/{photos} --ratio 0.5 -o @/{name}.ply")).success();
        assert!(folder.read(&format!("{name}.ply")) == folder.read(&format!("out/{name}.ply")), "capture {name}");
        let record: Value = serde_json::from_slice(&folder.read(&format!("out/{name}.json"))).expect("JSON");
        assert_eq!(
            (&record["photos"], record["bytes"].as_u64()),
            (&2.into(), Some(folder.read(&format!("out/{name}.ply")).len() as u64))
        );
    }
}

#[test]
fn makes_the_scenes_of_pixels_of_reconstruct() {
    let folder = captures().with_depth();
    let weights = "--weights @/da3.safetensors --input-size 42x42 --ratio 0.5 --per-view-focal";
    let line = format!("--json reconstruct --each {weights} @/all/1 @/all/10 -o @/out");
    assert_eq!(numbers(folder.run(&line)), [2, 0, 0, 0]);
    for name in ["1", "10"] {
        folder.run(&format!("reconstruct {weights} @/all/{name} -o @/{name}.ply")).success();
        assert!(folder.read(&format!("{name}.ply")) == folder.read(&format!("out/{name}.ply")), "capture {name}");
    }
    let record: Value = serde_json::from_slice(&folder.read("out/1.json")).expect("JSON");
    assert_eq!((&record["network"], &record["photos"]), (&"da3-micro".into(), &2.into()));
    assert_eq!(numbers(folder.run(&line)), [0, 2, 0, 0]);
    assert_eq!(numbers(folder.run(&line.replace(" --per-view-focal", ""))), [2, 0, 0, 0]);

    folder.run("scene --seed 3 --views 2 --size 42x28 -o @/place").success();
    for weights in ["da3", "alone"] {
        let line = format!("@/place --weights @/{weights}.safetensors --input-size 42x42");
        assert_eq!(
            numbers(folder.run(&format!("--json reconstruct --each --cameras capture {line} -o @/{weights}"))),
            [1, 0, 0, 0]
        );
        let photos = line.replacen("@/place", "@/place/images", 1);
        folder.run(&format!("reconstruct {photos} --cameras @/place -o @/place.ply")).success();
        assert!(folder.read("place.ply") == folder.read(&format!("{weights}/place.ply")), "{weights}");
    }
    let refused = |rest: &str| folder.run(&format!("reconstruct --each @/all -o @/none {rest}"));
    refused("--weights @/alone.safetensors").fails(3, &["da3-micro-alone", "no camera decoder"]);
    refused("--weights @/da3.safetensors --max-gaussians-per-token 197")
        .fails(3, &["--max-gaussians-per-patch", "1 to 196"]);
    refused("--weights @/da3.safetensors --cameras capture --crop tiles")
        .fails(3, &["--crop tiles", "weights of ZipSplat"]);
    assert!(!folder.path("none").exists());
}

#[test]
fn goes_on_where_it_was() {
    let folder = captures();
    let line = "@/all -o @/out";
    assert_eq!(numbers(batch(&folder, &format!("{line} --limit 1"))), [1, 0, 0, 2]);
    assert_eq!(super::names(&folder.path("out")), ["1.json", "1.ply"]);
    let first = times(&folder, &["out/1.ply"]);
    folder.write("out/2.ply", "ply\ncomment zipsplat\n");
    assert_eq!(numbers(batch(&folder, line)), [2, 1, 0, 0]);
    assert_eq!(numbers(batch(&folder, line)), [0, 3, 0, 0]);
    assert_eq!(times(&folder, &["out/1.ply"]), first);
    photo(40, 30, 77).save_png(folder.path("all/1/1.png")).expect("a photo can be written");
    photo(40, 30, 78).save_png(folder.path("all/2/images/9.png")).expect("a photo can be written");
    assert_eq!(numbers(batch(&folder, line)), [2, 1, 0, 0]);
    let scene = folder.read("out/10.ply");
    folder.write("out/10.ply", &scene[..scene.len() - 4]);
    assert_eq!(numbers(batch(&folder, line)), [1, 2, 0, 0]);
    assert!(folder.read("out/10.ply") == scene);
    assert_eq!(numbers(batch(&folder, &format!("{line} --ratio 0.5"))), [3, 0, 0, 0]);
    assert_eq!(numbers(batch(&folder, &format!("{line} --ratio 0.5 --format spz"))), [3, 0, 0, 0]);
}

#[test]
fn one_that_fails_is_a_row_and_not_the_end() {
    let folder = captures();
    folder.write("all/1/1.png", "no picture");
    let outcome = batch(&folder, "@/all -o @/out");
    assert!(outcome.code == 1 && outcome.err.contains("failures.csv: 1 capture"), "{}", outcome.err);
    assert_eq!(numbers(outcome), [2, 0, 1, 0]);
    let table = folder.text("out/failures.csv");
    let rows: Vec<&str> = table.lines().collect();
    assert!(rows.len() == 2 && rows[0] == "capture,error", "{table}");
    assert!(rows[1].contains("all/1") && rows[1].contains("1.png"), "{table}");
    photo(40, 30, 7).save_png(folder.path("all/1/1.png")).expect("a photo can be written");
    assert_eq!(numbers(batch(&folder, "@/all -o @/out")), [1, 2, 0, 0]);
    assert!(!folder.path("out/failures.csv").exists());
}

#[test]
fn takes_lists_captures_and_cameras() {
    let folder = captures();
    folder.write("list.txt", "# two of them\nall/10\n\n  all/2  \n");
    assert_eq!(numbers(batch(&folder, "@/list.txt @/all/1 -o @/out")), [3, 0, 0, 0]);
    folder.run("scene --seed 3 --size 32x32 --views 3 -o @/posed").success();
    let line = format!("reconstruct {WEIGHTS} @/posed/images --cameras @/posed -o @/known.ply");
    folder.run(&line).success();
    assert_eq!(numbers(batch(&folder, "@/posed --cameras capture -o @/out")), [1, 0, 0, 0]);
    assert!(folder.read("known.ply") == folder.read("out/posed.ply"));
    assert_eq!(numbers(batch(&folder, "@/posed -o @/out")), [1, 0, 0, 0], "without its cameras it is another");
}

#[test]
fn what_cannot_be_done_is_refused_before_it_begins() {
    let folder = captures();
    let run = |line: &str| folder.run(&format!("reconstruct --each {WEIGHTS} {line}"));
    run("@/none -o @/out").fails(3, &["none"]);
    run("@/all/empty -o @/out").fails(3, &["captures", "empty", "images/"]);
    run("@/all -o @/out --format obj").fails(3, &["--format", "obj", ".ply"]);
    folder.make("more/1");
    photo(40, 30, 1).save_png(folder.path("more/1/a.png")).expect("a photo can be written");
    run("@/all @/more -o @/out").fails(3, &["name of", "more/1", "one of its own"]);
    folder.write("out/2.ply", "mine");
    run("@/all -o @/out").fails(3, &["file to replace", "2.ply"]);
    assert_eq!(folder.read("out/2.ply"), b"mine");
}

/// A record vouches for a scene of its size alone.
#[test]
fn scenes_that_others_edited_are_kept() {
    let folder = captures();
    let edited = "ply\nmine: no zipsplat\n";
    for format in ["ply", "splat"] {
        let line = format!("@/all/1 --format {format} -o @/{format}");
        assert_eq!(numbers(batch(&folder, &line)), [1, 0, 0, 0]);
        assert_eq!(numbers(batch(&folder, &format!("{line} --ratio 0.5"))), [1, 0, 0, 0]);
        folder.write(&format!("{format}/1.{format}"), edited);
        let refused = folder.run(&format!("reconstruct --each {WEIGHTS} {line}"));
        refused.fails(3, &["file to replace", &format!("1.{format}"), "--overwrite"]);
        assert_eq!(folder.text(&format!("{format}/1.{format}")), edited);
        assert_eq!(numbers(batch(&folder, &format!("{line} --overwrite"))), [1, 0, 0, 0]);
    }
}

#[test]
fn a_missing_folder_in_a_list_fails_alone() {
    let folder = captures();
    folder.write("list.txt", "all/1\nall/gone\nall/10\n");
    let outcome = folder.run(&format!("reconstruct --each {WEIGHTS} @/list.txt -o @/out"));
    assert_eq!(outcome.code, 1, "{}", outcome.err);
    assert_eq!(super::names(&folder.path("out")), ["1.json", "1.ply", "10.json", "10.ply", "failures.csv"]);
    let failures = folder.text("out/failures.csv");
    assert!(failures.lines().count() == 2 && failures.contains("all/gone"), "{failures}");
}

#[cfg(unix)]
#[test]
fn two_batches_do_not_share_an_output_folder() {
    let folder = captures();
    folder.make("out");
    let other = std::fs::File::open(folder.path("out")).expect("a folder");
    other.try_lock().expect("nobody else has it");
    let line = format!("reconstruct --each {WEIGHTS} @/all -o @/out");
    folder.run(&line).fails(3, &["--output", "another batch"]);
    assert_eq!(super::names(&folder.path("out")), Vec::<String>::new());
    drop(other);
    folder.run(&line).success();
}

#[test]
fn a_stop_leaves_whole_scenes_only() {
    let folder = captures();
    let stopped = AtomicBool::new(true);
    let outcome = command(&folder.line(&format!("reconstruct --each {WEIGHTS} @/all -o @/out")), &stopped);
    assert_eq!(outcome.code, 130, "{}", outcome.err);
    let written = |folder: &Path| if folder.is_dir() { super::names(folder) } else { Vec::new() };
    assert_eq!(written(&folder.path("out")), Vec::<String>::new());
}
