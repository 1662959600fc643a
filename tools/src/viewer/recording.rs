//! Camera paths of a page, rendered as by `render --cameras`.

use super::server::Answer;
use crate::{
    animation::{Animation, common_size},
    pictures::{self, Sinks},
    process::lock,
    scratch::Scratch,
    session::Stage,
};
use indicatif::ProgressBar;
use serde::Deserialize;
use std::{
    path::PathBuf,
    sync::{Mutex, atomic::AtomicBool},
};
use zipsplat::{
    Error, Result,
    gpu::{Device, DeviceOptions},
    stages::render::{RenderOptions, Renderer},
    types::{Intrinsics, Scene, poses::Capture},
};

const MOST: usize = 10_000;

/// One recording at a time.
pub struct Studio {
    options: DeviceOptions,
    ffmpeg: PathBuf,
    renderer: Mutex<Option<Renderer>>,
    bar: ProgressBar,
}

#[derive(Deserialize)]
pub struct Wanted {
    pub scene: String,
    /// camera_path.json.
    path: serde_json::Value,
    background: [f32; 3],
    fps: u16,
    format: Format,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Format {
    Mp4,
    Gif,
    Png,
}

impl Studio {
    pub fn new(device: Option<&Device>, options: DeviceOptions, ffmpeg: PathBuf) -> Self {
        Self { options, ffmpeg, renderer: Mutex::new(device.map(Renderer::new)), bar: ProgressBar::hidden() }
    }

    pub fn record(&self, scene: &Scene, wanted: &Wanted, cancelled: &AtomicBool) -> Result<Answer> {
        let folder = Scratch::new()?;
        let path = folder.path().join("camera_path.json");
        std::fs::write(&path, wanted.path.to_string()).map_err(|error| Error::io(&path, error))?;
        let poses = Capture::open_cameras(&path, &Intrinsics::from_fov(1, 1, 1.0, 1.0))?;
        let cameras: Vec<_> = poses.frames.iter().map(|frame| frame.camera).collect();
        if !(1..=MOST).contains(&cameras.len()) {
            return Err(Error::argument("pictures to record", cameras.len(), format!("1 to {MOST}")));
        }
        common_size(&cameras)?;
        if let Some(wrong) = wanted.background.iter().find(|channel| !(0.0..=1.0).contains(*channel)) {
            return Err(Error::argument("background", wrong, "channels from 0 to 1"));
        }
        let (name, kind) = match wanted.format {
            Format::Mp4 => ("recorded.mp4", "video/mp4"),
            Format::Gif => ("recorded.gif", "image/gif"),
            Format::Png => ("recorded.png", "image/apng"),
        };
        let file = folder.path().join(name);
        let animation = Animation::new(&file, wanted.fps, &self.ffmpeg)?;
        let request = RenderOptions { background: wanted.background, ..RenderOptions::default() };
        let mut cached = lock(&self.renderer);
        let renderer = match &mut *cached {
            Some(renderer) => renderer,
            None => cached.insert(Renderer::new(&Device::open(&self.options)?)),
        };
        renderer.set_scene(scene)?;
        let sinks = Sinks { animation: Some(animation), ..Sinks::default() };
        pictures::draw(renderer, &cameras, &request, sinks, &Stage::told_to(&self.bar, cancelled))?;
        let bytes = std::fs::read(&file).map_err(|error| Error::io(&file, error))?;
        Ok((kind, bytes))
    }

    pub fn done(&self) -> f64 {
        self.bar.position() as f64 / self.bar.length().unwrap_or(1).max(1) as f64
    }
}
