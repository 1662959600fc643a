use crate::{
    animation::{Animation, Encoder},
    outputs::{self, DEPTH_LEVELS},
    session::Stage,
};
use rayon::prelude::*;
use std::{
    io::Write,
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, sync_channel},
    thread,
};
use zipsplat::{
    Error, Result,
    stages::render::{RenderOptions, RenderOutput, Renderer},
    types::{Camera, Image, resample::resize_lanczos},
};

pub const SHEET: &str = "contact.png";
const SHEET_SIDE: u32 = 4096;
const BATCH: u64 = 8;
const BATCH_PIXELS: u64 = 1 << 24;
/// Half a level of 256.
const VISIBLE: f32 = 0.5 / 255.0;

#[derive(Default)]
pub struct Sinks<'a> {
    pub folder: Option<&'a Path>,
    pub raw: Option<&'a mut dyn Write>,
    pub animation: Option<Animation>,
}

pub struct Drawn {
    pub small: Vec<Image>,
    pub empty: bool,
}

/// Files in addition to `000.png`.
fn layers(request: &RenderOptions) -> [(&'static str, bool); 5] {
    [
        ("", request.rgb),
        (".depth", request.depth.is_some()),
        (".alpha", request.alpha),
        (".normal", request.normals),
        (".tokens", request.token_group.is_some()),
    ]
}

fn file(folder: &Path, number: usize, layer: &str) -> PathBuf {
    folder.join(format!("{number:03}{layer}.png"))
}

pub fn files(folder: &Path, count: usize, request: &RenderOptions) -> impl Iterator<Item = PathBuf> {
    let asked = layers(request).into_iter().filter(|(_, asked)| *asked);
    let files = asked.flat_map(move |(layer, _)| (0..count).map(move |number| (number, layer)));
    files.map(|(number, layer)| file(folder, number, layer)).chain([folder.join(SHEET)])
}

pub fn draw(
    renderer: &mut Renderer,
    cameras: &[Camera],
    request: &RenderOptions,
    sinks: Sinks<'_>,
    stage: &Stage<'_>,
) -> Result<Drawn> {
    let batch = batch(cameras);
    let drawn = Drawn { small: Vec::new(), empty: true };
    let mut writer = Writer { sinks, encoder: None, drawn, background: request.background, frames: cameras.len() };
    thread::scope(|scope| {
        let (sender, frames) = sync_channel(batch);
        let drawing = scope.spawn(move || {
            renderer.render_each(cameras, request, |index, frame| {
                stage.reach(index as f64 / cameras.len() as f64)?;
                // Gone after a write error, which is reported.
                sender.send(frame).map_err(|_| Error::Cancelled)
            })
        });
        let written = writer.write_all(frames, batch);
        let drawn = drawing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        written.and(drawn)
    })?;
    writer.encoder.map_or(Ok(()), |encoder| encoder.finish(stage))?;
    Ok(writer.drawn)
}

pub fn sheet_columns(frames: usize) -> usize {
    (1..).find(|columns| columns * columns >= frames).unwrap_or(frames)
}

/// Fewer than [`BATCH`] for large pictures.
fn batch(cameras: &[Camera]) -> usize {
    let pixels = |camera: &Camera| u64::from(camera.intrinsics.width) * u64::from(camera.intrinsics.height);
    let largest = cameras.iter().map(pixels).max().unwrap_or(0).max(1);
    (BATCH_PIXELS / largest).clamp(1, BATCH) as usize
}

struct Writer<'a> {
    sinks: Sinks<'a>,
    encoder: Option<Box<dyn Encoder>>,
    drawn: Drawn,
    background: [f32; 3],
    frames: usize,
}

impl Writer<'_> {
    fn write_all(&mut self, frames: Receiver<RenderOutput>, batch: usize) -> Result<()> {
        let mut done = 0;
        while let Ok(first) = frames.recv() {
            let mut waiting = vec![first];
            waiting.extend(frames.try_iter().take(batch - 1));
            self.write(done, &waiting)?;
            done += waiting.len();
        }
        Ok(())
    }

    fn write(&mut self, done: usize, frames: &[RenderOutput]) -> Result<()> {
        let images: Vec<Result<Image>> = frames.par_iter().map(image).collect();
        let images = images.into_iter().collect::<Result<Vec<Image>>>()?;
        self.drawn.empty &= frames.iter().all(|frame| is_empty(frame, self.background));
        let Sinks { folder, raw, animation } = &mut self.sinks;
        if let Some(folder) = *folder {
            outputs::make_folder(folder)?;
            let save = |(i, (frame, image))| save(folder, done + i, frame, image, self.frames);
            let saved: Vec<Result<Image>> = frames.par_iter().zip(&images).enumerate().map(save).collect();
            for image in saved {
                self.drawn.small.push(image?);
            }
        }
        if let Some(animation) = animation {
            if self.encoder.is_none() {
                self.encoder = Some(animation.begin((images[0].width, images[0].height), self.frames)?);
            }
            self.encoder.iter_mut().try_for_each(|encoder| encoder.push(&images))?;
        }
        if let Some(raw) = raw {
            let written = images.iter().try_for_each(|image| raw.write_all(&image.rgb)).and_then(|()| raw.flush());
            written.map_err(|error| Error::io("standard output", error))?;
        }
        Ok(())
    }
}

fn is_empty(frame: &RenderOutput, background: [f32; 3]) -> bool {
    let pixels = frame.rgb.as_deref().unwrap_or_default().chunks_exact(3);
    let mut pairs = pixels.flat_map(|pixel| pixel.iter().zip(background));
    pairs.all(|(value, behind)| (value - behind).abs() < VISIBLE)
}

fn image(frame: &RenderOutput) -> Result<Image> {
    Image::from_rgb_f32(frame.width, frame.height, frame.rgb.as_deref().unwrap_or_default())
}

fn save(folder: &Path, number: usize, frame: &RenderOutput, image: &Image, frames: usize) -> Result<Image> {
    let &RenderOutput { width, height, .. } = frame;
    let path = |layer: &str| file(folder, number, layer);
    outputs::save_picture(&path(""), image)?;
    if let Some(depth) = &frame.depth {
        outputs::save_depth(&path(".depth"), [width, height], depth, DEPTH_LEVELS)?;
    }
    if let Some(alpha) = &frame.alpha {
        outputs::save_alpha(&path(".alpha"), width, height, alpha)?;
    }
    if let Some(normals) = &frame.normals {
        let half: Vec<f32> = normals.iter().map(|n| 0.5 + 0.5 * n).collect();
        outputs::save_picture(&path(".normal"), &Image::from_rgb_f32(width, height, &half)?)?;
    }
    if let Some(colors) = &frame.token_colors {
        outputs::save_picture(&path(".tokens"), &Image::from_rgb_f32(width, height, colors)?)?;
    }
    let cell = SHEET_SIDE / sheet_columns(frames) as u32;
    if width.max(height) <= cell {
        return Ok(image.clone());
    }
    let scale = f64::from(cell) / f64::from(width.max(height));
    let [width, height] = [width, height].map(|side| ((f64::from(side) * scale) as u32).max(1));
    resize_lanczos(image, width, height)
}
