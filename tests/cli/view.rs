//! Pages for a browser, and the server that hands them out.

use crate::{Folder, Outcome, command};
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
use zipsplat::types::{Scene, decode_scene, read_scene, write_ply};
use zipsplat_cli::{Terminal, run};
use zipsplat_tests::scenes;

fn folder() -> Folder {
    let folder = Folder::new();
    write_ply(&scenes::random_scene(50, 3, 0.1), folder.path("scene.ply")).expect("a scene can be written");
    folder
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> &'a str {
    let (_, rest) = text.split_once(start).unwrap_or_else(|| panic!("{start} is not in the page"));
    rest.split_once(end).unwrap_or_else(|| panic!("{end} is not behind {start}")).0
}

fn scene_within(page: &str, index: usize) -> Scene {
    let start = format!("<script id=scene-{index} type=application/octet-stream>");
    decode_scene(&base64(between(page, &start, "</script>")), None).expect("a scene")
}

fn base64(text: &str) -> Vec<u8> {
    BASE64_STANDARD.decode(text).expect("base64")
}

#[test]
fn a_page_has_its_scenes_within_it_and_asks_nobody() {
    let folder = folder();
    let json = folder.run("view @/scene.ply @/scene.ply --exact -o @/page.html --json").json();
    assert_eq!(json["gaussians"], serde_json::json!([50, 50]));
    let page = std::fs::read_to_string(folder.path("page.html")).expect("a page");
    assert_eq!(json["bytes"], page.len());
    let truth = read_scene(folder.path("scene.ply")).expect("a scene");
    assert_eq!([0, 1].map(|i| scene_within(&page, i)), [truth.clone(), truth]);
    for request in ["http://", "https://", "src=", "@import", "url("] {
        assert!(!page.contains(request), "{request}");
    }
    let policy = between(&page, "http-equiv=Content-Security-Policy content=\"", "\"");
    assert!(policy.contains("default-src 'none'") && policy.contains("connect-src 'none'"), "{policy}");
    // A browser runs no other script than that of this sum.
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
    assert!(bytes("") < bytes("--exact"));
    let page = std::fs::read_to_string(folder.path("page.html")).expect("a page");
    assert_eq!(scene_within(&page, 0).len(), 50);
    std::fs::write(folder.path("page.html"), "<!doctype html>mine").expect("a file can be written");
    folder.run("view @/scene.ply -o @/page.html").fails(3, &["page.html", "--overwrite"]);
    folder.run("view @/scene.ply -o @/page.html --overwrite").success();
}

#[test]
fn a_file_name_is_no_part_of_the_page() {
    let folder = folder();
    std::fs::rename(folder.path("scene.ply"), folder.path("<script>&.ply")).expect("a file can be renamed");
    folder.run("view @/<script>&.ply -o @/page.html").success();
    let page = std::fs::read_to_string(folder.path("page.html")).expect("a page");
    assert!(page.contains("<title>&lt;script>&amp;.ply</title>"));
    assert!(page.contains(r#""name":"\u003cscript>&.ply""#));
    assert!(!page.contains("<script>&.ply"));
}

#[test]
fn what_cannot_be_viewed_is_refused() {
    let folder = folder();
    std::fs::write(folder.path("text.ply"), "no scene").expect("a file can be written");
    let before = folder.names();
    folder.run("view @/text.ply -o @/page.html").fails(3, &["text.ply"]);
    folder.run("view @/scene.ply -o @/page.ply").fails(3, &["page.ply", "FILE.html"]);
    folder.run("view @/scene.ply --poses @/none.json -o @/page.html").fails(3, &["none.json"]);
    assert_eq!(folder.names(), before);
    assert_eq!(folder.run("view").code, 2);
    assert_eq!(folder.run("view @/scene.ply --exact").code, 2);
}

/// Hands on what is printed as it is printed.
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

/// Sends a request and gives the status and the body of the answer.
fn ask(port: &str, request: &str) -> (u16, Vec<u8>) {
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a server");
    stream.write_all(format!("{request}\r\nConnection: close\r\n\r\n").as_bytes()).expect("a request can be sent");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").expect("a header");
    let header = String::from_utf8_lossy(&answer[..end]).into_owned();
    (header[9..12].parse().expect("a status"), answer[end + 4..].to_vec())
}

#[test]
fn a_server_answers_its_own_page_and_nobody_else() {
    let folder = folder();
    folder.run("scene --seed 3 --views 2 --size 28x28 -o @/place").success();
    let line = folder.line("zipsplat view @/scene.ply --poses @/place/transforms.json");
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
        let address = text.lines().next().expect("a line").strip_prefix("http://127.0.0.1:").expect("this machine");
        let (port, path) = address.split_at(address.find('/').expect("a path"));
        assert_eq!(path.len(), 2 + 32, "{path}");
        let get =
            |path: &str, headers: &str| ask(port, &format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}{headers}"));

        let (status, page) = get(path, "");
        let page = String::from_utf8(page).expect("text");
        assert!(status == 200 && page.starts_with("<!doctype html>") && page.contains("connect-src 'self'"));
        assert_eq!(get(path, &format!("\r\nOrigin: http://127.0.0.1:{port}")).0, 200);
        let (status, scene) = get(&format!("{path}scene/0"), "");
        let scene = decode_scene(&scene, None).expect("a scene");
        assert_eq!((status, scene), (200, read_scene(folder.path("scene.ply")).expect("a scene")));
        let (status, photo) = get(&format!("{path}photo/1"), "");
        assert!(status == 200 && photo.starts_with(b"\xff\xd8"), "a JPEG");

        let wrong = path.replace(|c: char| c.is_ascii_hexdigit(), "0");
        for other in ["/", "/favicon.ico", &path[..path.len() - 1], &wrong, &format!("{wrong}scene/0")] {
            assert_eq!(get(other, "").0, 404, "{other}");
        }
        for other in ["scene/1", "photo/2", "scene/../../../etc/passwd", "other", "scene/"] {
            assert_eq!(get(&format!("{path}{other}"), "").0, 404, "{other}");
        }
        for origin in
            ["http://example.org", "null", "https://127.0.0.1", &format!("http://127.0.0.1:{port}.example.org")]
        {
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
        cancelled.store(true, Ordering::Relaxed);
        let (code, err) = serving.join().expect("it ends");
        assert_eq!(code, 0, "{err}");
    });
}
