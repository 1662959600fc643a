//! The viewer's server against malicious and stalling clients.
#![cfg(unix)]

use crate::view::{ask, folder, served};
use std::{
    io::{Read, Write},
    net::TcpStream,
    os::unix::fs::PermissionsExt,
    path::Path,
    time::Duration,
};
use zipsplat_tests::processes::{assert_succeeds, child, target};

#[test]
fn no_client_ends_or_holds_the_page() {
    let folder = folder();
    served(&folder.line("zipsplat view @/scene.ply"), |port, path| {
        let open = |start: &str| {
            let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("a server");
            stream.write_all(start.as_bytes()).expect("a request can be sent");
            stream
        };
        let post = |path: &str, length: &str| {
            format!("POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: {length}\r\n\r\n")
        };
        let answer = |mut stream: TcpStream| {
            let mut answer = Vec::new();
            // Closing an incomplete request resets the connection.
            let _ = stream.read_to_end(&mut answer);
            String::from_utf8_lossy(&answer).into_owned()
        };
        let is_served = |after: &str| {
            let (status, _) = ask(port, &format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}"));
            assert_eq!(status, 200, "after {after}");
        };
        let record = format!("{path}record");
        for (at, length, status) in [
            ("/x", "100000000000000", " 404 "),
            (&record, "100000000000000", " 413 "),
            (&record, "16777217", " 413 "),
            ("/x", "18446744073709551615", " 431 "),
            (&record, "18446744073709551615", " 431 "),
        ] {
            let found = answer(open(&post(at, length)));
            assert!(found.starts_with("HTTP/1.1") && found.contains(status), "{at} {length}: {found}");
            is_served(length);
        }
        let mut endless = open(&format!("GET {path} HTTP/1.1\r\nX: "));
        let sent = (0..1000).take_while(|_| endless.write_all(&[b'a'; 1 << 16]).is_ok()).count();
        assert!(sent < 1000, "a header of {sent} blocks");
        is_served("an endless header");
        let bodies: Vec<_> = (0..8).map(|_| open(&post(&record, "100000"))).collect();
        is_served("stalled bodies");
        let headers: Vec<_> = (0..200).map(|_| open("GET / HTTP/1.1\r\nHost:")).collect();
        is_served("stalled headers");
        std::mem::forget((bodies, headers));
    });
}

#[test]
#[ignore = "child of the next test"]
fn opens_the_page() {
    let Some(folder) = target() else { return };
    let line = format!("zipsplat view {} --open", folder.join("scene.ply").display());
    served(&line, |port, path| {
        let opened = folder.join("opened");
        while !opened.exists() {
            std::thread::sleep(Duration::from_millis(5));
        }
        let file = std::fs::read_to_string(opened).expect("arguments");
        let page = std::fs::read_to_string(file.trim()).expect("a page");
        assert!(page.contains(&format!("url=http://127.0.0.1:{port}{path}\"")), "{page}");
        let mode = std::fs::metadata(file.trim()).expect("a page").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    });
    let file = std::fs::read_to_string(folder.join("opened")).expect("arguments");
    assert!(!Path::new(file.trim()).exists(), "{file}");
}

#[test]
fn no_command_line_has_the_address_of_the_page() {
    let folder = folder();
    folder.script("xdg-open", "#!/bin/sh\necho \"$@\" > \"$OPENED.part\"\nmv \"$OPENED.part\" \"$OPENED\"\n");
    let mut child = child("server::opens_the_page", &folder.path(""), "");
    let path = std::env::var("PATH").unwrap_or_default();
    child.env("PATH", format!("{}:{path}", folder.path("").display())).env("OPENED", folder.path("opened"));
    assert_succeeds(child);
}
