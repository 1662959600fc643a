//! One HTML file with everything in it: style, scripts, and the scenes where these are to be within the page.

use super::InputCamera;
use base64::{Engine, prelude::BASE64_STANDARD, write::EncoderWriter};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::io::{Result, Write};
use zipsplat::types::LeftOut;

const PAGE: &str = include_str!("../../viewer/page.html");
const STYLE: &str = include_str!("../../viewer/style.css");
/// The scripts of the page, in this order.
const SCRIPT: &str = concat!(
    include_str!("../../viewer/camera.js"),
    include_str!("../../viewer/controls.js"),
    include_str!("../../viewer/renderer.js"),
    include_str!("../../viewer/overlay.js"),
    include_str!("../../viewer/tokens.js"),
    include_str!("../../viewer/views.js"),
    include_str!("../../viewer/path.js"),
    include_str!("../../viewer/live.js"),
    include_str!("../../viewer/refining.js"),
    include_str!("../../viewer/page.js"),
);
/// The script that runs beside it.
const WORKER: &str = concat!(include_str!("../../viewer/formats.js"), include_str!("../../viewer/worker.js"));

/// The contents of a page.
#[derive(Default, Serialize)]
pub struct Config {
    /// The scenes, in the order of the slider.
    pub scenes: Vec<ShownScene>,
    /// Cameras to look through, in the world of the scenes.
    pub cameras: Vec<InputCamera>,
    /// The world's direction against gravity, where it is known.
    pub up: Option<[f64; 3]>,
    /// The photos as the network saw them, where it made the scenes.
    pub views: Vec<View>,
    /// Rows and columns of the patches of each of them.
    pub grid: [usize; 2],
    /// Scenes of any ratio can be asked for.
    pub live: Option<Ratios>,
    /// A refinement is under way.
    pub refines: bool,
    /// The sentence under the slider.
    pub note: Option<String>,
}

/// A scene as the page names it before it is loaded.
#[derive(Default, Serialize)]
pub struct ShownScene {
    /// The name of its file.
    pub name: String,
    /// The size of its file.
    pub bytes: u64,
    /// Gaussians of a token, which follow each other.
    pub group: Option<usize>,
    /// The patch that each token is of, see [`zipsplat::reconstruct::Reconstruction::patches`].
    pub patches: Vec<u32>,
    /// Stages and the milliseconds that each took.
    pub times: Vec<(String, f64)>,
    /// The stages that were not needed, and why.
    pub left_out: Vec<LeftOut>,
}

/// A picture that the network saw.
#[derive(Serialize)]
pub struct View {
    /// The photo's name.
    pub name: String,
    /// The picture's address.
    pub photo: String,
}

/// The scenes that can be asked for.
#[derive(Serialize)]
pub struct Ratios {
    /// Tokens at ratio 1.
    pub tokens: usize,
    /// The ratio to begin with.
    pub ratio: f64,
    /// Precisions that the device computes in, the one to begin with first.
    pub precisions: Vec<&'static str>,
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
