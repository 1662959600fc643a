use crate::{
    Folder, Outcome, command,
    host::{Act, Host, sha256},
};
use serde_json::{Value, json};
use std::{
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::atomic::AtomicBool,
    time::Duration,
};
use zipsplat::weights::Checkpoint;
use zipsplat_cli::cancelled_by_signals;
use zipsplat_tests::processes::{assert_succeeds, child, target};

const GET: &str = "weights get zipsplat --yes --timeout 2";
const PART: &str = "zipsplat-da3g-252p.tar.part";

#[test]
#[ignore = "child of the other tests"]
fn runs_a_line() {
    let Some(folder) = target() else { return };
    let line = std::fs::read_to_string(folder.join("line")).expect("a line");
    // No signal handlers to inherit.
    let never = AtomicBool::new(false);
    let Outcome { code, out, err } =
        command(&line, if folder.join("stoppable").exists() { cancelled_by_signals() } else { &never });
    std::fs::write(folder.join("outcome"), json!([code, out, err]).to_string()).expect("written");
}

struct Place {
    folder: Folder,
    environment: Vec<(&'static str, String)>,
}

impl Place {
    fn new(host: &Host) -> Self {
        let folder = Folder::new();
        let hub = format!("http://127.0.0.1:{}/", host.port);
        let environment = vec![("HF_ENDPOINT", hub), ("HF_TOKEN", "secret".into())];
        Self { folder, environment }
    }

    fn process(&self, line: &str) -> Command {
        self.folder.write("line", self.folder.line(line));
        let mut process = child("weights::runs_a_line", &self.folder.path(""), "set -- env --default-signal \"$@\"");
        for name in ["ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"] {
            process.env_remove(name).env_remove(name.to_lowercase());
        }
        process.env_remove("HF_HUB_OFFLINE").env("ZIPSPLAT_CACHE", self.folder.path("cache")).stdin(Stdio::null());
        process.envs(self.environment.iter().map(|(name, value)| (name, value)));
        process
    }

    fn outcome(&self) -> Outcome {
        let text = self.folder.read("outcome");
        let (code, out, err) = serde_json::from_slice(&text).expect("an outcome");
        Outcome { code, out, err }
    }

    fn run(&self, line: &str) -> Outcome {
        assert_succeeds(self.process(line));
        self.outcome()
    }

    fn cached(&self) -> Vec<String> {
        let folder = self.folder.path("cache/weights");
        if folder.exists() { crate::names(&folder) } else { Vec::new() }
    }

    fn part(&self) -> PathBuf {
        self.folder.path("cache/weights").join(PART)
    }
}

fn weights() -> Vec<u8> {
    std::fs::read(Folder::new().path("micro.safetensors")).expect("weights")
}

fn converted(file: &[u8]) -> String {
    format!("zipsplat-da3g-252p-{}-f16.safetensors", &sha256(file)[..12])
}

#[test]
fn named_weights_are_got_checked_converted_and_found() {
    let file = weights();
    let host = Host::new(file.clone(), &[]);
    let place = Place::new(&host);
    place
        .run("reconstruct --dry-run --views 2 --weights zipsplat")
        .fails(3, &["weights zipsplat", "`zipsplat weights get zipsplat`"]);
    let list = |state: &str| {
        let rows = place.run("weights list --json").json();
        assert_eq!((&rows[1]["name"], &rows[1]["state"]), (&"zipsplat".into(), &state.into()), "{rows}");
        assert_eq!((&rows[0]["name"], &rows[0]["state"]), (&"builtin".into(), &"built in".into()));
    };
    list("to get");
    let got = place.run(&format!("{GET} --json"));
    assert!(got.err.contains("CC BY-NC") && got.err.contains("no commercial use"), "{}", got.err);
    let json = got.json();
    assert_eq!(place.cached(), [converted(&file)]);
    let path = json["path"].as_str().expect("a path").to_owned();
    assert!(path.ends_with(&converted(&file)), "{path}");
    let opened = Checkpoint::open(&path, None).expect("it names itself");
    assert_eq!(
        (opened.architecture().name.as_str(), json["bytes"].as_u64() < Some(file.len() as u64)),
        ("micro", true)
    );
    list("cached");
    assert_eq!(place.run("weights path zipsplat").success().trim(), path);
    assert!(place.run("reconstruct --dry-run --views 2 --weights zipsplat").success().contains("MiB"));
    let requests = host.state().requests.clone();
    assert!(requests.iter().all(|[_, path, _, token]| (token == "true") == (path != "/blob")), "{requests:?}");
    assert_eq!(host.ranges(), [""]);
    place.run(GET).success();
    place.run("weights get zipsplat --offline").success();
    assert_eq!(host.ranges().len(), 1);
    host.state().etag = Some("0".repeat(64));
    let newer = place.run("weights get zipsplat");
    assert!(newer.err.contains("newer weights than"), "{}", newer.err);
    newer.fails(3, &["--yes"]);
}

#[test]
fn weights_of_depth_stay_as_they_are() {
    let file = std::fs::read(Folder::new().with_depth().path("da3.safetensors")).expect("weights");
    let third = file.len() / 3;
    let host = Host::new(file.clone(), &[Act::Cut(third)]);
    let place = Place::new(&host);
    let missing = ["weights da3-small", "`zipsplat weights get da3-small`"];
    place.run("convert da3-small").fails(3, &missing);
    place.run("depth @/photos --weights da3-small -o @/out").fails(3, &missing);
    for name in ["da3-large", "vggt-1b"] {
        place.run(&format!("weights get {name}")).fails(3, &["no --yes", "CC BY-NC 4.0", "no commercial use"]);
    }
    let got = place.run("weights get da3-small --yes --timeout 2 --json");
    assert!(got.err.contains("Apache-2.0"), "{}", got.err);
    let path = got.json()["path"].as_str().expect("a path").to_owned();
    assert_eq!(host.ranges(), [String::new(), format!("bytes={third}-")]);
    let name = |of: &str| format!("{of}-{}.safetensors", &sha256(&file)[..12]);
    assert_eq!(place.cached(), [name("da3-small")]);
    assert!(std::fs::read(&path).expect("weights") == file);
    assert_eq!(place.run("convert da3-small --json").json()["kind"], "Depth Anything 3");
    place.run("depth @/photos --weights da3-small --input-size 42 -o @/out").success();
    let line = "cameras @/photos --method da3 --weights da3-small --matching-size 64 -o @/cameras.json";
    place.run(line).success();
    place.run("reconstruct @/photos --weights da3-small --input-size 42x42 -o @/scene.ply").success();
    place.run("depth @/photos --weights zipsplat -o @/out").fails(3, &["zipsplat, of ZipSplat", "da3-small"]);
    place.run("weights get da3-small --yes").success();
    place.run("weights get da3-small --offline").success();
    assert_eq!(host.ranges().len(), 2);
    place.run("weights get da3-large --yes").success();
    assert_eq!(place.cached(), [name("da3-large-1.1"), name("da3-small")]);
    let states = place.run("weights list --json").json();
    let cached = states.as_array().expect("rows").iter().filter(|row| row["state"] == "cached");
    assert_eq!(
        cached.map(|row| row["name"].as_str().unwrap_or_default()).collect::<Vec<_>>(),
        ["da3-small", "da3-large"]
    );
    let host = Host::new(weights(), &[]);
    let place = Place::new(&host);
    place.run("weights get da3-small --yes").fails(3, &["da3-small"]);
}

#[test]
fn a_network_that_breaks_costs_no_bytes_that_came() {
    let file = weights();
    let (third, from) = (file.len() / 3, |start: usize| format!("bytes={start}-"));
    let whole = String::new;
    for (acts, ranges) in [
        (vec![Act::Cut(third), Act::Cut(third)], vec![whole(), from(third), from(2 * third)]),
        (vec![Act::Stall(third)], vec![whole(), from(third)]),
        (vec![Act::Cut(third), Act::Ignore], vec![whole(), from(third)]),
        (vec![Act::Cut(third), Act::Shift], vec![whole(), from(third), whole()]),
        (vec![Act::Cut(third), Act::Status(416)], vec![whole(), from(third), whole()]),
        (vec![Act::Cut(third), Act::Status(503), Act::Cut(0)], vec![whole(), from(third), from(third), from(third)]),
    ] {
        let host = Host::new(file.clone(), &acts);
        let place = Place::new(&host);
        place.run(GET).success();
        assert_eq!(host.ranges(), ranges, "{acts:?}");
        assert_eq!(place.cached(), [converted(&file)], "{acts:?}");
    }
}

#[test]
fn another_run_goes_on_and_notices_another_file() {
    let file = weights();
    let third = file.len() / 3;
    let broken = [&[Act::Cut(third)][..], &[Act::Status(503); 5]].concat();
    let host = Host::new(file.clone(), &broken);
    let place = Place::new(&host);
    let outcome = place.run(GET);
    assert!(outcome.err.contains("are kept: `zipsplat weights get zipsplat` goes on"), "{}", outcome.err);
    outcome.fails(1, &["HTTP 503", "5 times in a row"]);
    assert_eq!(place.part().metadata().expect("a part").len(), third as u64);
    let rows = place.run("weights list --json").json();
    assert_eq!((&rows[1]["state"], rows[1]["bytes"].as_u64()), (&"begun".into(), Some(file.len() as u64)));
    place.run("weights path zipsplat").fails(3, &["none in"]);
    let asked = host.ranges().len();
    place.run(GET).success();
    assert_eq!(host.ranges()[asked..], [format!("bytes={third}-")]);

    let other: Vec<u8> = std::fs::read(place.folder.path("cache/weights").join(converted(&file))).expect("f16");
    let host = Host::new(file, &broken);
    let place = Place::new(&host);
    assert_eq!(place.run(GET).code, 1);
    host.state().etag = Some(sha256(&other));
    host.state().file = other.clone();
    let asked = host.ranges().len();
    place.run(&format!("{GET} --keep-download")).success();
    assert_eq!(host.ranges()[asked..], [""]);
    let archive = format!("zipsplat-da3g-252p-{}.tar", &sha256(&other)[..12]);
    assert_eq!(place.cached(), [converted(&other), archive]);
    std::fs::remove_file(place.folder.path("cache/weights").join(converted(&other))).expect("removed");
    place.run("weights get zipsplat --offline").success();
    assert_eq!(place.cached(), [converted(&other)]);
}

#[test]
fn stopping_keeps_what_came() {
    let file = weights();
    let third = file.len() / 3;
    let host = Host::new(file.clone(), &[Act::Stall(third)]);
    let place = Place::new(&host);
    place.folder.write("stoppable", "");
    let mut child: Child = place.process("weights get zipsplat --yes --timeout 600").spawn().expect("bash");
    while !place.part().metadata().is_ok_and(|found| found.len() == third as u64) {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before it loaded anything");
        std::thread::sleep(Duration::from_millis(5));
    }
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(sent.expect("kill").success() && child.wait().expect("it ends").success());
    let outcome = place.outcome();
    assert!(outcome.err.contains("are kept: `zipsplat weights get zipsplat` goes on"), "{}", outcome.err);
    outcome.fails(130, &["cancelled"]);
    place.run(GET).success();
    assert_eq!(host.ranges(), ["".to_owned(), format!("bytes={third}-")]);
}

#[test]
fn two_processes_get_one_file() {
    let file = weights();
    let host = Host::new(file.clone(), &[Act::Stall(file.len() / 3)]);
    let [first, mut second] = [Place::new(&host), Place::new(&host)];
    second.environment.push(("ZIPSPLAT_CACHE", first.folder.path("cache").display().to_string()));
    let mut loads = first.process("weights get zipsplat --yes --timeout 3").spawn().expect("bash");
    while !first.part().metadata().is_ok_and(|found| found.len() > 0) {
        assert!(loads.try_wait().expect("a child").is_none(), "it ended before it loaded anything");
        std::thread::sleep(Duration::from_millis(5));
    }
    second.run(GET).success();
    assert!(loads.wait().expect("it ends").success());
    first.outcome().success();
    assert_eq!(first.cached(), [converted(&file)]);
    assert_eq!(host.ranges().len(), 2, "the second process loads nothing");
}

#[test]
fn a_link_in_the_cache_is_not_followed() {
    let host = Host::new(weights(), &[]);
    let place = Place::new(&host);
    let victim = place.folder.path("victim");
    std::fs::write(&victim, "kept").expect("written");
    place.folder.make("cache/weights");
    std::os::unix::fs::symlink(&victim, place.part()).expect("a link");
    place.run(GET).fails(3, &[PART, "a symbolic link", "expected a regular file"]);
    assert_eq!(std::fs::read(&victim).expect("a file"), b"kept");
}

#[test]
fn what_cannot_be_got_is_refused() {
    let file = weights();
    let spoiled = |spoil: &dyn Fn(&Host)| {
        let host = Host::new(file.clone(), &[]);
        spoil(&host);
        (Place::new(&host), host)
    };
    let (place, host) = spoiled(&|host| host.state().etag = Some("0".repeat(64)));
    place.run(GET).fails(3, &["SHA-256: found", &sha256(&file), "expected 0000", "get it again"]);
    assert!(place.cached().is_empty() && host.ranges().len() == 1, "{:?}", place.cached());
    let (place, host) = spoiled(&|host| host.state().size = Some(1_000_000_000_000_000));
    place.run(GET).fails(3, &["size of http", "909.49 TiB", "about 5.40 GiB"]);
    assert!(host.ranges().is_empty() && !place.part().exists());
    let (place, _) = spoiled(&|host| host.state().etag = None);
    place.run(GET).fails(3, &["SHA-256 of http", "none in the host's answer", "--sha256"]);
    place.run(&format!("{GET} --sha256 {}", sha256(&file))).success();
    let (place, host) = spoiled(&|host| host.state().acts.push_back(Act::Swap(100)));
    place.run(GET).fails(3, &["the host has another file since", "run the command again"]);
    assert_eq!((host.ranges().len(), place.part().exists()), (2, true));
    let (place, host) = spoiled(&|_| ());
    place.run(&format!("{GET} --sha256 {}", "1".repeat(64))).fails(3, &["--sha256: found 111", "which the host says"]);
    place.run("weights get zipsplat").fails(3, &["no --yes, and no terminal to ask on", "CC BY-NC"]);
    place.run("weights get zipsplat --offline").fails(3, &["no network by --offline"]);
    let (pinned, _) = spoiled(&|_| ());
    pinned.run(GET).success();
    pinned.run(&format!("weights get zipsplat --offline --sha256 {}", sha256(&file))).success();
    pinned.run(&format!("weights get zipsplat --offline --sha256 {}", "1".repeat(64))).fails(3, &["no network"]);
    place.run("weights get brush").fails(3, &["name of weights: found brush, expected zipsplat"]);
    assert!(host.ranges().is_empty() && place.cached().is_empty());
    for (status, code, words) in [(404, 3, "HTTP 404"), (401, 3, "HF_TOKEN"), (500, 1, "5 times in a row")] {
        let (place, _) = spoiled(&|host| host.state().refuses = Some(status));
        place.run(GET).fails(code, &[words, "zipsplat-da3g-252p.tar: "]);
    }
    let (mut place, host) = spoiled(&|_| ());
    place.environment.push(("HF_HUB_OFFLINE", "1".into()));
    place.run(GET).fails(3, &["no network by HF_HUB_OFFLINE"]);
    place.environment = vec![("HF_ENDPOINT", "hub".into())];
    place.run(GET).fails(3, &["HF_ENDPOINT: found hub"]);
    place.environment = vec![("HF_ENDPOINT", "http://127.0.0.1:1".into())];
    place.run(GET).fails(1, &["refused", "5 times in a row"]);
    assert!(host.state().requests.is_empty());
    assert_eq!(crate::zipsplat("weights get zipsplat --sha256 12").code, 2);
}

#[test]
fn a_proxy_is_used() {
    let host = Host::new(weights(), &[]);
    let mut place = Place::new(&host);
    let proxy = format!("http://127.0.0.1:{}", host.port);
    place.environment = vec![("HF_ENDPOINT", "http://hub.invalid".into()), ("ALL_PROXY", proxy)];
    place.run(GET).success();
    let requests: Vec<Value> = host.state().requests.iter().map(|request| json!(request[..2])).collect();
    assert!(requests.contains(&json!(["CONNECT", "hub.invalid:80"])), "{requests:?}");
}
