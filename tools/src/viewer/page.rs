//! One HTML file with everything in it: style, scripts, and the scenes where these are to be within the page.

use super::InputCamera;
use base64::{Engine, prelude::BASE64_STANDARD, write::EncoderWriter};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::io::{Result, Write};

const PAGE: &str = include_str!("../../viewer/page.html");
const STYLE: &str = include_str!("../../viewer/style.css");
/// The scripts of the page, in this order.
const SCRIPT: &str = concat!(
    include_str!("../../viewer/camera.js"),
    include_str!("../../viewer/controls.js"),
    include_str!("../../viewer/renderer.js"),
    include_str!("../../viewer/overlay.js"),
    include_str!("../../viewer/page.js"),
);
/// The script that runs beside it.
const WORKER: &str = concat!(include_str!("../../viewer/formats.js"), include_str!("../../viewer/worker.js"));

/// The contents of a page.
#[derive(Serialize)]
pub struct Config {
    /// The scenes, in the order of the slider.
    pub scenes: Vec<ShownScene>,
    /// Cameras to look through, in the world of the scenes.
    pub cameras: Vec<InputCamera>,
    /// The world's direction against gravity, where it is known.
    pub up: Option<[f64; 3]>,
}

/// A scene as the page names it before it is loaded.
#[derive(Serialize)]
pub struct ShownScene {
    /// The name of its file.
    pub name: String,
    /// The size of its file.
    pub bytes: u64,
}

/// Whom a page may ask for anything.
#[derive(Clone, Copy)]
pub enum Requests {
    /// Nobody: its scenes are within it.
    None,
    /// The server that it comes from.
    Server,
}

/// Writes a page. `scenes` are the bytes of those that are within it, in the order of the configuration.
///
/// # Errors
/// The errors of writing.
pub fn write_page(out: &mut dyn Write, config: &Config, requests: Requests, scenes: &[Vec<u8>]) -> Result<()> {
    let names: Vec<&str> = config.scenes.iter().map(|scene| scene.name.as_str()).collect();
    let mut rest = PAGE;
    while let Some((before, behind)) = rest.split_once("{{") {
        let (name, after) = behind.split_once("}}").expect("the template closes what it opens");
        out.write_all(before.as_bytes())?;
        match name {
            "policy" => out.write_all(policy(requests).as_bytes())?,
            "title" => out.write_all(escaped(&names.join(", ")).as_bytes())?,
            "style" => out.write_all(STYLE.as_bytes())?,
            // Within a script of JSON no character ends the element but this one.
            "config" => out.write_all(serde_json::to_string(config)?.replace('<', "\\u003c").as_bytes())?,
            "worker" => out.write_all(WORKER.as_bytes())?,
            "scenes" => scenes.iter().enumerate().try_for_each(|(i, bytes)| write_scene(out, i, bytes))?,
            "script" => out.write_all(SCRIPT.as_bytes())?,
            _ => unreachable!("the template asks for {name}"),
        }
        rest = after;
    }
    out.write_all(rest.as_bytes())
}

fn write_scene(out: &mut dyn Write, index: usize, bytes: &[u8]) -> Result<()> {
    write!(out, "<script id=scene-{index} type=application/octet-stream>")?;
    let mut encoder = EncoderWriter::new(&mut *out, &BASE64_STANDARD);
    encoder.write_all(bytes)?;
    encoder.finish()?;
    drop(encoder);
    out.write_all(b"</script>\n")
}

/// A page runs its own script and no other, and asks nobody else for anything.
fn policy(requests: Requests) -> String {
    let script = BASE64_STANDARD.encode(Sha256::digest(SCRIPT));
    let (connect, image) = match requests {
        Requests::None => ("'none'", ""),
        Requests::Server => ("'self'", " 'self'"),
    };
    format!(
        "default-src 'none'; script-src 'sha256-{script}'; worker-src blob:; style-src 'unsafe-inline'; \
         img-src data: blob:{image}; connect-src {connect}; base-uri 'none'; form-action 'none'"
    )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}
