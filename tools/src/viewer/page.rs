//! Self-contained: style, scripts and optional scenes.

use super::{InputCamera, ShownFeatures};
use crate::html::escape;
use base64::{Engine, prelude::BASE64_STANDARD, write::EncoderWriter};
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::io::{Result, Write};
use zipsplat::types::SkippedPass;

const PAGE: &str = include_str!("../../viewer/page.html");
const STYLE: &str = include_str!("../../viewer/style.css");
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
    include_str!("../../viewer/edit.js"),
    include_str!("../../viewer/page.js"),
);
const WORKER: &str = concat!(
    include_str!("../../viewer/zstd.js"),
    include_str!("../../viewer/formats.js"),
    include_str!("../../viewer/writers.js"),
    include_str!("../../viewer/worker.js")
);

#[derive(Default, Serialize)]
pub struct Config {
    /// In slider order.
    pub scenes: Vec<ShownScene>,
    /// In the scenes' world.
    pub cameras: Vec<InputCamera>,
    pub up: Option<[f64; 3]>,
    /// Empty for scene files.
    pub views: Vec<View>,
    /// Patch rows and columns of a view.
    pub grid: [usize; 2],
    pub live: Option<Ratios>,
    pub refines: bool,
    /// Sentence under the slider.
    pub note: Option<String>,
}

#[derive(Default, Serialize)]
pub struct ShownScene {
    pub name: String,
    pub bytes: u64,
    /// Consecutive Gaussians per token.
    pub group: Option<usize>,
    /// Per token, see [`zipsplat::reconstruct::Reconstruction::patches`].
    pub patches: Vec<u32>,
    /// Milliseconds.
    pub times: Vec<(String, f64)>,
    pub skipped_passes: Vec<SkippedPass>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub features: Option<ShownFeatures>,
}

#[derive(Serialize)]
pub struct View {
    pub name: String,
    pub photo: String,
}

#[derive(Serialize)]
pub struct Ratios {
    pub tokens: usize,
    pub ratio: f64,
    /// The initial one first.
    pub precisions: Vec<&'static str>,
}

#[derive(Clone, Copy)]
pub enum Requests {
    /// The scenes are embedded.
    None,
    Server,
}

/// Embeds `scenes`, in configuration order.
pub fn write_page(out: &mut dyn Write, config: &Config, requests: Requests, scenes: &[Vec<u8>]) -> Result<()> {
    let names: Vec<&str> = config.scenes.iter().map(|scene| scene.name.as_str()).collect();
    let (script, mut rest) = (packed(SCRIPT), PAGE);
    while let Some((before, behind)) = rest.split_once("{{") {
        let (name, after) = behind.split_once("}}").expect("the template closes what it opens");
        out.write_all(before.as_bytes())?;
        match name {
            "policy" => out.write_all(policy(&script, requests).as_bytes())?,
            "title" => out.write_all(escape(&names.join(", ")).as_bytes())?,
            "style" => out.write_all(STYLE.as_bytes())?,
            // Only this character can end the element.
            "config" => out.write_all(serde_json::to_string(config)?.replace('<', "\\u003c").as_bytes())?,
            "worker" => out.write_all(packed(WORKER).as_bytes())?,
            "scenes" => {
                for (i, (bytes, shown)) in scenes.iter().zip(&config.scenes).enumerate() {
                    write_bytes(out, &format!("scene-{i}"), bytes)?;
                    if let Some(features) = &shown.features {
                        write_bytes(out, &format!("features-{i}"), &features.bytes)?;
                    }
                }
            }
            "script" => out.write_all(script.as_bytes())?,
            _ => unreachable!("the template asks for {name}"),
        }
        rest = after;
    }
    out.write_all(rest.as_bytes())
}

fn write_bytes(out: &mut dyn Write, id: &str, bytes: &[u8]) -> Result<()> {
    write!(out, "<script id={id} type=application/octet-stream>")?;
    let mut encoder = EncoderWriter::new(&mut *out, &BASE64_STANDARD);
    encoder.write_all(bytes)?;
    encoder.finish()?;
    drop(encoder);
    out.write_all(b"</script>\n")
}

fn packed(script: &str) -> String {
    let lines = script.lines().map(str::trim_start).filter(|line| !line.starts_with("//"));
    lines.flat_map(|line| [line, "\n"]).collect()
}

/// Allows only the page's script and these requests.
fn policy(script: &str, requests: Requests) -> String {
    let script = BASE64_STANDARD.encode(Sha256::digest(script));
    let (connect, image) = match requests {
        Requests::None => ("'none'", ""),
        Requests::Server => ("'self'", " 'self'"),
    };
    format!(
        "default-src 'none'; script-src 'sha256-{script}'; worker-src blob:; style-src 'unsafe-inline'; \
         img-src data: blob:{image}; connect-src {connect}; base-uri 'none'; form-action 'none'"
    )
}
