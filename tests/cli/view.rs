use crate::{Folder, Outcome, command, select};
use base64::{Engine, prelude::BASE64_STANDARD};
use sha2::{Digest, Sha256};
use std::{
    io::{Read, Write},
    net::TcpStream,
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::{Sender, channel},
    },
};
use zipsplat::{
    Edit,
    types::{Scene, poses::write_transforms, write_ply},
};
use zipsplat_cli::{Terminal, run};
use zipsplat_tests::{photos::with_orientation, scenes};

pub fn folder() -> Folder {
    let folder = Folder::new();
    folder.scatter("scene.ply", 50, 3, 0.1);
    folder
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> &'a str {
    let (_, rest) = text.split_once(start).unwrap_or_else(|| panic!("{start} is not in the page"));
    rest.split_once(end).unwrap_or_else(|| panic!("{end} is not behind {start}")).0
}

fn scene_within(page: &str, index: usize) -> Scene {
    let start = format!("<script id=scene-{index} type=application/octet-stream>");
    Scene::decode(&base64(between(page, &start, "</script>")), None).expect("a scene")
}

fn base64(text: &str) -> Vec<u8> {
    BASE64_STANDARD.decode(text).expect("base64")
}

#[test]
fn a_page_has_its_scenes_within_it_and_asks_nobody() {
    let folder = folder();
    let json = folder.run("view @/scene.ply @/scene.ply --lossless -o @/page.html --json").json();
    assert_eq!(json["gaussians"], serde_json::json!([50, 50]));
    let page = folder.text("page.html");
    assert_eq!(json["bytes"], page.len());
    let truth = Scene::open(folder.path("scene.ply")).expect("a scene");
    assert_eq!([0, 1].map(|i| scene_within(&page, i)), [truth.clone(), truth]);
    for request in ["http://", "https://", "src=", "@import", "url("] {
        assert!(!page.contains(request), "{request}");
    }
    let policy = between(&page, "http-equiv=Content-Security-Policy content=\"", "\"");
    assert!(policy.contains("default-src 'none'") && policy.contains("connect-src 'none'"), "{policy}");
    let script = page.rsplit_once("<script>").expect("a script").1;
    let script = script.split_once("</script>").expect("its end").0;
    assert_eq!(base64(between(policy, "sha256-", "'")), Sha256::digest(script).to_vec());
}

#[test]
fn a_packed_page_is_smaller_and_is_replaced_but_no_page_of_others() {
    let folder = folder();
    let bytes = |options: &str| {
        folder.run(&format!("view @/scene.ply -o @/page.html --json {options}")).json()["bytes"]
            .as_u64()
            .expect("a size")
    };
    assert!(bytes("") < bytes("--lossless"));
    let page = folder.text("page.html");
    assert_eq!(scene_within(&page, 0).len(), 50);
    folder.write("page.html", "<!doctype html>mine");
    folder.run("view @/scene.ply -o @/page.html").fails(3, &["page.html", "--overwrite"]);
    folder.run("view @/scene.ply -o @/page.html --overwrite").success();
}

#[test]
fn a_file_name_is_no_part_of_the_page() {
    let folder = folder();
    std::fs::rename(folder.path("scene.ply"), folder.path("<script>&.ply")).expect("a file can be renamed");
    folder.run("view @/<script>&.ply -o @/page.html").success();
    let page = folder.text("page.html");
    assert!(page.contains("<title>&lt;script&gt;&amp;.ply</title>"));
    assert!(page.contains(r#""name":"\u003cscript>&.ply""#));
    assert!(!page.contains("<script>&.ply"));
}

#[test]
fn what_cannot_be_viewed_is_refused() {
    let folder = folder();
    folder.write("text.ply", "no scene");
    let before = folder.names();
    folder.run("view @/text.ply -o @/page.html").fails(3, &["text.ply"]);
    folder.run("view @/scene.ply -o @/page.ply").fails(3, &["page.ply", "FILE.html"]);
    folder.run("view @/scene.ply --cameras @/none.json -o @/page.html").fails(3, &["none.json"]);
    assert_eq!(folder.names(), before);
    assert_eq!(folder.run("view").code, 2);
    assert_eq!(folder.run("view @/scene.ply --lossless").code, 2);
}

#[test]
fn photos_become_scenes_of_several_ratios() {
    let folder = Folder::new();
    let view = |options: &str| {
        folder.run(&format!("view @/photos --weights @/micro.safetensors --input-size 56x28 -o @/page.html {options}"))
    };
    let json = view("--json").json();
    assert_eq!(json["gaussians"], serde_json::json!([64, 32, 16, 4]));
    let page = folder.text("page.html");
    let config: serde_json::Value =
        serde_json::from_str(between(&page, "id=config type=application/json>", "</script>"))
            .expect("the configuration is JSON");
    let scenes = config["scenes"].as_array().expect("scenes");
    assert_eq!(scenes[2]["name"], "ratio 0.25");
    assert_eq!(scenes[2]["group"], 4);
    let patches: Vec<u64> =
        scenes[2]["patches"].as_array().expect("patches").iter().filter_map(|p| p.as_u64()).collect();
    assert!(patches.len() == 4 && patches.iter().all(|patch| *patch < 16), "{patches:?}");
    assert_eq!((&config["grid"], config["views"].as_array().map(Vec::len)), (&serde_json::json!([2, 4]), Some(2)));
    assert!(config["views"][0]["photo"].as_str().is_some_and(|photo| photo.starts_with("data:image/jpeg;base64,")));
    assert_eq!(scene_within(&page, 2).len(), 16);
    assert_eq!(view("--ratios 0.5,1,0.51 --json").json()["gaussians"], serde_json::json!([64, 32]));
    assert_eq!(view("--ratios 0.5 --max-gaussians-per-token 2 --json").json()["gaussians"], serde_json::json!([16]));
}

/// Least and largest, within the first half and across.
fn similarities(rows: &[&[u8]]) -> [[f64; 2]; 2] {
    let dot = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| f64::from(*a as i8) * f64::from(*b as i8)).sum::<f64>();
    let cosine = |a: &[u8], b: &[u8]| dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
    let (left, right) = rows.split_at(rows.len() / 2);
    [left, right].map(|others| {
        let all = || left.iter().flat_map(|row| others.iter().map(|other| cosine(row, other)));
        [all().fold(f64::INFINITY, f64::min), all().fold(f64::NEG_INFINITY, f64::max)]
    })
}

#[test]
fn a_page_has_the_features_that_it_is_given() {
    let folder = folder();
    let mut scene = select::objects(&folder);
    scene.opacities.iter_mut().enumerate().for_each(|(i, opacity)| *opacity = 0.3 + 0.001 * i as f32);
    write_ply(&scene, folder.path("scene.ply")).expect("a scene can be written");
    select::picture(&folder, "labels/a.png", [18, 2]);
    select::picture(&folder, "labels/b.png", [18, 2]);
    folder.run("lift @/scene.ply @/labels --labels 20 --cameras @/cameras.json -o @/labels.safetensors").success();
    let page = |options: &str| {
        folder.run(&format!("view @/scene.ply {options} -o @/page.html --overwrite")).success();
        folder.text("page.html")
    };
    let [without, with] = ["", "--features @/labels.safetensors"].map(page);
    let features = "<script id=features-0 type=application/octet-stream>";
    assert!(!without.contains(features) && !without.contains("\"features\":"));
    assert!(with.contains("\"features\":{\"channels\":16}"));
    let bytes = base64(between(&with, features, "</script>"));
    assert_eq!((bytes.len(), with.len() - without.len() > 200 * 16), (200 * 16, true));
    let [within, across] = similarities(&bytes.chunks(16).collect::<Vec<_>>());
    assert!(within[0] > 0.99 && across[1].abs() < 0.01, "{within:?} {across:?}");

    served(&folder.line("zipsplat view @/scene.ply --features @/labels.safetensors"), |port, path| {
        let get = |asked: &str| ask(port, &format!("GET {path}{asked} HTTP/1.1\r\nHost: 127.0.0.1:{port}"));
        let sources = scene.edit(&[Edit::Sort], &[]).expect("a scene").sources;
        let sorted: Vec<u8> = sources.iter().flat_map(|i| &bytes[i * 16..][..16]).copied().collect();
        assert!(sorted != bytes && get("features/0") == (200, sorted));
        assert_eq!(get("features/1").0, 404);
    });
    served(&folder.line("zipsplat view @/scene.ply"), |port, path| {
        assert_eq!(ask(port, &format!("GET {path}features/0 HTTP/1.1\r\nHost: 127.0.0.1:{port}")).0, 404);
    });

    folder.scatter("other.ply", 200, 3, 0.1);
    let refused = |line: &str, words: &[&str]| folder.run(&format!("view {line} -o @/none.html")).fails(3, words);
    refused("@/other.ply --features @/labels.safetensors", &["labels.safetensors", "features of scene"]);
    refused("@/scene.ply @/other.ply --features @/labels.safetensors", &["--features", "1 file", "2 scenes"]);
    refused("@/photos --features @/labels.safetensors", &["--features", "a scene's file"]);
    assert!(!folder.path("none.html").exists());
}

#[test]
fn photos_that_are_given_go_with_a_page() {
    let folder = folder();
    folder.run("scene --seed 3 --views 2 --size 28x28 -o @/place").success();
    let view = |options: &str| {
        let line = format!("view @/scene.ply --cameras @/place/transforms.json -o @/page.html --json {options}");
        let json = folder.run(&line).json();
        let page = folder.text("page.html");
        (json["photos"].as_u64(), page.matches("\"photo\":\"data:image/jpeg;base64,").count())
    };
    assert_eq!(view(""), (Some(0), 0));
    assert_eq!(view("--photos @/place/images"), (Some(2), 2));
}

#[test]
fn a_page_has_the_refined_scene() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 3 --size 28x28 -o @/place").success();
    let line = "view @/place/images --cameras @/place --weights @/micro.safetensors --input-size 28x28 --ratios 1";
    let json = folder.run(&format!("{line} --refine=2 -o @/page.html --json")).json();
    assert_eq!(json["gaussians"].as_array().map(Vec::len), Some(2));
    assert!(folder.text("page.html").contains(r#""name":"refined""#));
}

#[test]
fn pages_without_photos_show_turned_ones_upright() {
    let folder = folder();
    let jpeg = crate::photo(40, 30, 0).jpeg(90).expect("a photo");
    folder.write("photo.jpg", with_orientation(&jpeg, 6));
    write_transforms(folder.path("c.json"), &[scenes::camera(40, 30)], &["photo.jpg"]).expect("a camera");
    folder.run("view @/scene.ply --cameras @/c.json -o @/page.html").success();
    let page = folder.text("page.html");
    let config: serde_json::Value =
        serde_json::from_str(between(&page, "id=config type=application/json>", "</script>")).expect("JSON");
    let camera = &config["cameras"][0];
    assert!(camera["photo"].is_null() && camera["width"] == 30 && camera["height"] == 40, "{camera}");
}

#[test]
fn photos_and_scenes_have_options_of_their_own() {
    let folder = folder();
    folder.run("view @/scene.ply @/photos -o @/page.html").fails(3, &["scene.ply", "scenes alone, or photos alone"]);
    folder.run("view @/scene.ply --ratio 0.5 -o @/page.html").fails(3, &["--ratio", "photos"]);
    folder.run("view @/scene.ply --views 2 -o @/page.html").fails(3, &["--views", "photos"]);
    let photos = "view @/photos --weights @/micro.safetensors --input-size 28x28 -o @/page.html";
    folder.run(&format!("{photos} --gaussians-per-token 4")).fails(3, &["--gaussians-per-token", "a scene's file"]);
    folder.run(&format!("{photos} --ratios 0.5,2")).fails(3, &["--ratios", "2", "(0, 1]"]);
    folder.run(&format!("{photos} --ratios 1,.9,.8,.7,.6,.5,.4,.3,.2")).fails(3, &["--ratios", "9", "at most 8"]);
    folder.run(&format!("{photos} --refine=5 --colmap @/none")).fails(3, &["COLMAP"]);
    folder.run("view @/photos --weights @/micro.safetensors --ratios 0.5").fails(3, &["--ratios", "served"]);
    assert!(!folder.path("page.html").exists());
}

struct Printed(Sender<Vec<u8>>);

impl Write for Printed {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.send(bytes.to_vec()).map_err(std::io::Error::other)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

pub fn ask(port: &str, request: &str) -> (u16, Vec<u8>) {
    send(port, request, "")
}

fn send(port: &str, request: &str, body: &str) -> (u16, Vec<u8>) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a server");
    stream
        .write_all(format!("{request}\r\nConnection: close\r\n\r\n{body}").as_bytes())
        .expect("a request can be sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").expect("a header");
    let header = String::from_utf8_lossy(&answer[..end]).into_owned();
    (header[9..12].parse().expect("a status"), answer[end + 4..].to_vec())
}

struct Ended<'a>(&'a AtomicBool);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Calls `test` with port and page path, then stops the server.
pub fn served(line: &str, test: impl FnOnce(&str, &str)) {
    let (cancelled, (send, printed)) = (AtomicBool::new(false), channel());
    std::thread::scope(|scope| {
        let serving = scope.spawn(|| {
            let (mut out, mut err) = (Printed(send), Vec::new());
            let args = line.split_whitespace().map(Into::into);
            let code = run(args, Terminal { out: &mut out, err: &mut err, progress: false, cancelled: &cancelled });
            (code, String::from_utf8_lossy(&err).into_owned())
        });
        let mut text = String::new();
        while !text.contains('\n') {
            text += &String::from_utf8_lossy(&printed.recv().expect("an address is printed"));
        }
        // A failing test would otherwise wait.
        let ended = Ended(&cancelled);
        let address = text.lines().next().expect("a line");
        let address = address.strip_prefix("http://127.0.0.1:").expect("this machine");
        let (port, path) = address.split_at(address.find('/').expect("a path"));
        test(port, path);
        drop(ended);
        let (code, err) = serving.join().expect("it ends");
        assert_eq!(code, 0, "{err}");
    });
}

#[test]
fn a_server_makes_scenes_of_the_ratio_that_is_asked_for() {
    let folder = Folder::new();
    let line = folder.line("zipsplat view @/photos --weights @/micro.safetensors --input-size 56x28 --ratio 0.5");
    served(&line, |port, path| {
        let host = format!("HTTP/1.1\r\nHost: 127.0.0.1:{port}");
        let get = |asked: &str| ask(port, &format!("GET {path}{asked} {host}"));
        for (ratio, tokens) in [("1", 16), ("0.25", 4), ("0.0001", 1)] {
            let (status, bytes) = get(&format!("made/{ratio}/fp32"));
            assert_eq!(status, 200, "{}", String::from_utf8_lossy(&bytes));
            let end = bytes.iter().position(|byte| *byte == b'\n').expect("a line about the scene");
            let facts: serde_json::Value = serde_json::from_slice(&bytes[..end]).expect("JSON");
            assert_eq!(facts["patches"].as_array().map(Vec::len), Some(tokens));
            let stages: Vec<_> = facts["times"].as_array().expect("times").iter().map(|time| &time[0]).collect();
            assert!(stages.iter().any(|stage| **stage == "fuse") && stages.iter().all(|stage| **stage != "backbone"));
            assert_eq!(Scene::decode(&bytes[end + 1..], None).expect("a scene").len(), 4 * tokens);
        }
        assert_eq!(get("view/1").0, 200);
        for wrong in ["view/2", "made/0.5", "made/0.5/wrong", "made/half/fp32", "refined", "refining", "record"] {
            assert_eq!(get(wrong).0, 404, "{wrong}");
        }
        assert_eq!([get(&format!("made/0.5/fp32?{}", u64::MAX)).0, get("made/0.5/fp32?1").0], [200, 200]);
        assert_eq!(get("made/NaN/fp32").0, 500);
        let (status, words) = get("made/2/fp32");
        assert!(status == 500 && String::from_utf8_lossy(&words).contains("(0, 1]"), "{words:?}");

        let matrix = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let camera = serde_json::json!({ "camera_to_world": matrix, "fov": 50.0, "aspect": 1.0 });
        let record_at = |scene: &str, frames: usize, fps: u32, background: [f64; 3]| {
            let path_of = serde_json::json!({ "camera_type": "perspective", "render_width": 24, "render_height": 16,
                "camera_path": vec![&camera; frames] });
            let body = serde_json::json!({ "scene": scene, "path": path_of, "background": background, "fps": fps,
                "format": "gif" })
            .to_string();
            let length = body.len();
            send(port, &format!("POST {path}record {host}\r\nContent-Length: {length}"), &body)
        };
        let record = |scene: &str, frames: usize| record_at(scene, frames, 10, [1.0, 0.0, 0.0]);
        let (status, gif) = record("made/0.5/fp32", 3);
        assert!(status == 200 && gif.starts_with(b"GIF89a"), "{status} {}", String::from_utf8_lossy(&gif));
        let (status, words) = record("scene/0", 3);
        assert!(status == 500 && String::from_utf8_lossy(&words).contains("scene to record"));
        assert_eq!(record("made/0.5/fp32", 0).0, 500);
        for (fps, background, words) in
            [(0, [0.0; 3], "fps"), (51, [0.0; 3], "fps"), (65_536, [0.0; 3], "u16"), (10, [2.0; 3], "background")]
        {
            let (status, found) = record_at("made/0.5/fp32", 3, fps, background);
            let found = String::from_utf8_lossy(&found).into_owned();
            assert!(status == 500 && found.contains(words) && !found.contains("defect"), "{fps}: {status} {found}");
        }
    });
}

#[test]
fn a_server_answers_its_own_page_and_nobody_else() {
    let folder = folder();
    folder.run("scene --seed 3 --views 2 --size 28x28 -o @/place").success();
    served(&folder.line("zipsplat view @/scene.ply --cameras @/place/transforms.json"), |port, path| {
        assert_eq!(path.len(), 2 + 32, "{path}");
        let get =
            |path: &str, headers: &str| ask(port, &format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}{headers}"));

        let (status, page) = get(path, "");
        let page = String::from_utf8(page).expect("text");
        assert!(status == 200 && page.starts_with("<!doctype html>") && page.contains("connect-src 'self'"));
        assert_eq!(get(path, &format!("\r\nOrigin: http://127.0.0.1:{port}")).0, 200);
        let (status, scene) = get(&format!("{path}scene/0"), "");
        let scene = Scene::decode(&scene, None).expect("a scene");
        let file = Scene::open(folder.path("scene.ply")).expect("a scene");
        assert!(status == 200 && scene == file.edit(&[Edit::Sort], &[]).expect("a scene").scene);
        let (status, photo) = get(&format!("{path}photo/1"), "");
        assert!(status == 200 && photo.starts_with(b"\xff\xd8"), "a JPEG");

        let wrong = path.replace(|c: char| c.is_ascii_hexdigit(), "0");
        for other in ["/", "/favicon.ico", &path[..path.len() - 1], &wrong, &format!("{wrong}scene/0")] {
            assert_eq!(get(other, "").0, 404, "{other}");
        }
        for other in ["scene/1", "photo/2", "scene/../../../etc/passwd", "other", "scene/"] {
            assert_eq!(get(&format!("{path}{other}"), "").0, 404, "{other}");
        }
        let subdomain = format!("http://127.0.0.1:{port}.example.org");
        for origin in ["http://example.org", "null", "https://127.0.0.1", &subdomain] {
            assert_eq!(get(path, &format!("\r\nOrigin: {origin}")).0, 403, "{origin}");
        }
        for host in
            ["example.org".into(), format!("example.org:{port}"), "127.0.0.1".into(), format!("127.0.0.1:{port}x")]
        {
            assert_eq!(ask(port, &format!("GET {path} HTTP/1.1\r\nHost: {host}")).0, 403, "{host}");
        }
        assert_eq!(ask(port, &format!("GET {path} HTTP/1.1\r\nAccept: */*")).0, 403, "no Host");
        let post = format!("POST {path} HTTP/1.1\r\nContent-Length: 0\r\nHost: 127.0.0.1:{port}");
        assert_eq!(ask(port, &post).0, 405);

        let taken = folder.line(&format!("view @/scene.ply --port {port}"));
        let Outcome { code, err, .. } = command(&taken, &AtomicBool::new(false));
        assert!(code != 0 && err.contains(&format!("port {port}")), "{err}");
    });
}

#[test]
fn options_of_a_refinement_need_one() {
    for option in ["--max-gaussians 100", "--optimize-cameras", "--init points", "--holdout-views 1"] {
        folder().run(&format!("view @/photos --cameras @/cameras.json {option}")).fails_usage();
    }
}
