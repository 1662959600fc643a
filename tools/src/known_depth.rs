//! Depth of photos by sensors, other programs or a depth network.

use crate::{
    depth::PredictorOptions,
    file_names::{self, unique_stems},
    lifted::{check_shape, values_files},
    npy,
    options::ArithmeticOption,
    outputs::DEPTH_LEVELS,
    released::open_depth,
    session::{Session, Stage},
    stamp::{digest, stamp},
};
use exr::prelude::{MetaData, ReadChannels, ReadLayers, Vec2};
use safetensors::SafeTensors;
use serde_json::Value;
use std::{
    borrow::Cow,
    fmt::Display,
    path::{Path, PathBuf},
    sync::Arc,
};
use zipsplat::{
    Error, Result,
    refine::{DepthKind, Photos},
    types::{Camera, Image, Intrinsics, poses::CaptureView},
    weights::DepthHeads,
};

/// Depth of all photos, of `depth`.
pub const VALUES: &str = "depths.safetensors";
/// Photos' names without extension.
pub const PHOTOS: &str = "zipsplat.photos";

const EXTENSIONS: [&str; 3] = ["npy", "exr", "png"];
const MAX_PIXELS: usize = 1 << 28;

pub struct KnownDepth {
    pub kind: DepthKind,
    maps: Vec<Option<DepthMap>>,
    /// Length of the scene's unit in that of metric depth.
    unit: f64,
}

struct DepthMap {
    source: Source,
    /// Of the whole photo, and of the refinement's.
    photo: Intrinsics,
    refined: Intrinsics,
}

enum Source {
    File(PathBuf),
    Predicted { values: Arc<[f32]>, intrinsics: Intrinsics },
}

impl KnownDepth {
    /// `source`: a folder, a transforms.json, or the name or weights of a depth network. `cameras`
    /// are the refinement's; the scene's unit has the length `unit`.
    pub fn open(
        session: &mut Session<'_>,
        source: &Path,
        files: &[PathBuf],
        frames: &[&CaptureView],
        cameras: &[Camera],
        unit: f64,
    ) -> Result<Self> {
        frames.iter().try_for_each(|frame| check_lens("--depth-loss", frame))?;
        let file = source.join(VALUES);
        let (kind, sources) = match (source.is_dir(), file.is_file()) {
            (true, true) => (DepthKind::Relative, read_values(&file, files, frames)?),
            (true, false) => {
                let found = values_files(source, frames, &EXTENSIONS)?.into_iter();
                (DepthKind::Metric, found.map(|file| file.map(Source::File)).collect())
            }
            _ if source.extension().is_some_and(|extension| extension == "json") => {
                (DepthKind::Metric, listed(source, frames)?)
            }
            (false, _) => (DepthKind::Relative, predict(session, file_names::text(source)?, files, frames)?),
        };
        let known = sources.iter().flatten().count();
        if known == 0 {
            let found = format!("none for {} and the other photos", file_names::names(&files[..files.len().min(1)]));
            return Err(absent(source, found));
        }
        if known < files.len() {
            let without = files.iter().zip(&sources).filter(|(_, source)| source.is_none());
            let without: Vec<PathBuf> = without.map(|(file, _)| file.clone()).collect();
            session.note(format!("photos without depth: {}", file_names::names(&without)));
        }
        let map = |((source, frame), camera): ((Option<Source>, &&CaptureView), &Camera)| {
            Some(DepthMap { source: source?, photo: frame.camera.intrinsics, refined: camera.intrinsics })
        };
        Ok(Self { kind, maps: sources.into_iter().zip(frames).zip(cameras).map(map).collect(), unit })
    }

    pub fn stamps(&self) -> Result<Vec<String>> {
        let of = |map: &Option<DepthMap>| match map.as_ref().map(|map| &map.source) {
            None => Ok("no depth".to_owned()),
            Some(Source::File(path)) => stamp(path),
            Some(Source::Predicted { values, .. }) => {
                let bits = |value: &f32| format!("{:08x}", value.to_bits());
                Ok(digest(&values.iter().map(bits).collect::<Vec<_>>()))
            }
        };
        self.maps.iter().map(of).collect()
    }

    fn read(&self, i: usize) -> Result<Option<Vec<f32>>> {
        let Some(DepthMap { source, photo, refined }) = &self.maps[i] else { return Ok(None) };
        match source {
            Source::File(path) => read_file(path, photo, refined, self.unit).map(Some),
            Source::Predicted { values, intrinsics } => Ok(Some(sampled(values, intrinsics, refined, 1.0))),
        }
    }
}

/// Photos with any known depth.
pub struct WithDepth<'a, P> {
    pub photos: P,
    pub depth: Option<&'a KnownDepth>,
    /// Stage whose cancellation ends the opening of photos.
    pub stage: Option<&'a Stage<'a>>,
}

impl<P: Photos> Photos for WithDepth<'_, P> {
    fn count(&self) -> usize {
        self.photos.count()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        self.photos.size(i)
    }

    fn open(&self, i: usize) -> Result<Cow<'_, Image>> {
        self.stage.map_or(Ok(()), Stage::check)?;
        self.photos.open(i)
    }

    fn depth(&self, i: usize) -> Result<Option<Cow<'_, [f32]>>> {
        let depth = self.depth.map(|known| known.read(i)).transpose()?.flatten();
        Ok(depth.map(Cow::Owned))
    }
}

/// Files of `depth_file_path` in a transforms.json.
fn listed(file: &Path, frames: &[&CaptureView]) -> Result<Vec<Option<Source>>> {
    let text = std::fs::read_to_string(file).map_err(|error| Error::io(file, error))?;
    let json: Value = serde_json::from_str(&text).map_err(|error| Error::format(file, None, error.to_string()))?;
    let (listed, folder) = (json["frames"].as_array().map_or(&[][..], Vec::as_slice), file.parent());
    let path = |frame: &&CaptureView| {
        let of_photo = listed.iter().find(|listed| listed["file_path"] == frame.name.as_str())?;
        Some(Source::File(folder?.join(of_photo["depth_file_path"].as_str()?)))
    };
    Ok(frames.iter().map(path).collect())
}

fn absent(source: &Path, found: String) -> Error {
    let expected =
        format!("NAME.npy, NAME.exr or NAME.png for a photo NAME, {VALUES} of these photos, or depth_file_path");
    Error::argument(format!("depth in {}", source.display()), found, expected)
}

fn check_lens(option: &str, frame: &CaptureView) -> Result<()> {
    let found = format!("{}, whose lens distorts", frame.name);
    frame.lens.map_or(Ok(()), |_| Err(Error::argument(option, found, "photos of a pinhole camera")))
}

pub fn read(folder: &Path, frames: &[&CaptureView], cameras: &[Camera], unit: f64) -> Result<Vec<Vec<f32>>> {
    let read = |((file, frame), camera): ((Option<PathBuf>, &&CaptureView), &Camera)| {
        check_lens("--from-depth", frame)?;
        let file = file.ok_or_else(|| absent(folder, format!("none for {}", frame.name)))?;
        read_file(&file, &frame.camera.intrinsics, &camera.intrinsics, unit)
    };
    values_files(folder, frames, &EXTENSIONS)?.into_iter().zip(frames).zip(cameras).map(read).collect()
}

/// Depth of a whole photo, nearest sampled for a camera and divided by `unit`.
fn read_file(file: &Path, photo: &Intrinsics, camera: &Intrinsics, unit: f64) -> Result<Vec<f32>> {
    let ([width, height], values) = match file.extension().and_then(|extension| extension.to_str()) {
        Some("png") => read_png(file)?,
        Some("exr") => read_exr(file)?,
        _ => npy::read(file)?,
    };
    check_shape(file, [width, height], photo)?;
    if let Some(at) = values.iter().position(|value| !(value.is_finite() && *value >= 0.0)) {
        let (value, x, y) = (values[at], at as u32 % width, at as u32 / width);
        let reason = format!("found {value} at column {x}, row {y}, expected distances, or 0 if unknown");
        return Err(Error::format(file, None, reason));
    }
    Ok(sampled(&values, &photo.resized(width, height), camera, unit))
}

fn malformed(file: &Path, found: impl Display, expected: &str) -> Error {
    Error::format(file, None, format!("found {found}, expected {expected}"))
}

/// 16-bit levels, as of `render --depth` and many sensors: millimeters if a unit is a meter.
fn read_png(file: &Path) -> Result<([u32; 2], Vec<f32>)> {
    let expected = format!("a 16-bit gray PNG of {DEPTH_LEVELS} levels per unit");
    let picture = image::open(file).map_err(|error| malformed(file, error, &expected))?;
    let levels = picture.as_luma16().ok_or_else(|| malformed(file, format!("{:?}", picture.color()), &expected))?;
    Ok((levels.dimensions().into(), levels.iter().map(|level| f32::from(*level) / DEPTH_LEVELS).collect()))
}

fn read_exr(file: &Path) -> Result<([u32; 2], Vec<f32>)> {
    let unusable = |found: String| malformed(file, found, "an OpenEXR image of one channel, or of Z, Y, R or V");
    let failed = |error: exr::error::Error| unusable(error.to_string());
    let mut headers = MetaData::read_from_file(file, false).map_err(failed)?.headers.into_iter();
    let header = headers.next().ok_or_else(|| unusable("no image".into()))?;
    let (channels, Vec2(width, height)) = (header.channels.list, header.layer_size);
    let named = |name: &&str| channels.iter().position(|channel| channel.name.eq(name));
    let chosen = ["Z", "Y", "R", "V"].iter().find_map(named).or((channels.len() == 1).then_some(0));
    let chosen = chosen.filter(|i| channels[*i].sampling == Vec2(1, 1)).ok_or_else(|| {
        let names: Vec<String> = channels.iter().map(|channel| channel.name.to_string()).collect();
        unusable(format!("channels {}", names.join(", ")))
    })?;
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err(unusable(format!("{width}x{height} pixels")));
    }
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels();
    let layer = reader.first_valid_layer().all_attributes().from_file(file).map_err(failed)?.layer_data;
    let values = layer.channel_data.list.get(chosen).filter(|_| layer.size == header.layer_size);
    let values = values.ok_or_else(|| unusable("several images".into()))?.sample_data.values_as_f32();
    Ok(([width as u32, height as u32], values.collect()))
}

/// Nearest pixels of a map of intrinsics `from` for each of `to`, divided by `unit`; 0 outside.
fn sampled(values: &[f32], from: &Intrinsics, to: &Intrinsics, unit: f64) -> Vec<f32> {
    let [columns, rows] = [0, 1].map(|axis| pixels(axis, to, from));
    let value = |y: &Option<usize>, x: &Option<usize>| {
        let at = (*y)? * from.width as usize + (*x)?;
        Some((f64::from(values[at]) / unit) as f32)
    };
    rows.iter().flat_map(|y| columns.iter().map(move |x| value(y, x).unwrap_or(0.0))).collect()
}

fn pixels(axis: usize, of: &Intrinsics, from: &Intrinsics) -> Vec<Option<usize>> {
    let lens = |i: &Intrinsics| if axis == 0 { (i.fx, i.cx, i.width) } else { (i.fy, i.cy, i.height) };
    let ((f, c, count), (from_f, from_c, size)) = (lens(of), lens(from));
    let at = |k: u32| ((f64::from(k) + 0.5 - c) / f * from_f + from_c).floor();
    // A pixel's rounding may leave the map.
    let inside = |at: f64| (at >= -1.0 && at <= f64::from(size)).then(|| at.clamp(0.0, f64::from(size - 1)) as usize);
    (0..count).map(|k| inside(at(k))).collect()
}

fn read_values(file: &Path, photos: &[PathBuf], frames: &[&CaptureView]) -> Result<Vec<Option<Source>>> {
    let bytes = std::fs::read(file).map_err(|error| Error::io(file, error))?;
    let malformed = |found: String| malformed(file, found, "depth [photos, height, width] of `zipsplat depth`");
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| malformed(error.to_string()))?;
    let names = header.metadata().as_ref().and_then(|metadata| metadata.get(PHOTOS));
    let names: Vec<String> =
        names.and_then(|names| serde_json::from_str(names).ok()).ok_or_else(|| malformed(format!("no {PHOTOS}")))?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|error| malformed(error.to_string()))?;
    let depth = tensors.tensor("depth").map_err(|error| malformed(error.to_string()))?;
    let (shape, data) = (depth.shape(), depth.data());
    let [count, height, width] = *shape else { return Err(malformed(format!("{shape:?}"))) };
    if depth.dtype() != safetensors::Dtype::F32 || count != names.len() {
        return Err(malformed(format!("{:?} {shape:?} of {} photos", depth.dtype(), names.len())));
    }
    let size = [width as u32, height as u32];
    let source = |(stem, frame): (String, &&CaptureView)| {
        let Some(i) = names.iter().position(|name| *name == stem) else { return Ok(None) };
        check_shape(file, size, &frame.camera.intrinsics)?;
        let map = &data[4 * i * width * height..4 * (i + 1) * width * height];
        let value = |four: &[u8]| f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
        let values: Arc<[f32]> = map.chunks_exact(4).map(value).collect();
        if let Some(wrong) = values.iter().find(|value| !(value.is_finite() && **value >= 0.0)) {
            return Err(malformed(format!("{wrong} in the depth of {stem}")));
        }
        let intrinsics = frame.camera.intrinsics.resized(size[0], size[1]);
        Ok(Some(Source::Predicted { values, intrinsics }))
    };
    unique_stems(photos).into_iter().zip(frames).map(source).collect()
}

fn predict(
    session: &mut Session<'_>,
    network: &str,
    photos: &[PathBuf],
    frames: &[&CaptureView],
) -> Result<Vec<Option<Source>>> {
    let (checkpoint, arithmetic) = (open_depth(network, DepthHeads::default())?, ArithmeticOption::default());
    let predicted = PredictorOptions::of(&checkpoint, &arithmetic).ask(session, photos, frames)?;
    let source = |(i, frame): (usize, &&CaptureView)| {
        let label = photos[i].display().to_string();
        let intrinsics = predicted.views[i].map.apply(&frame.camera.intrinsics, &label)?;
        let values = predicted.depths.views[i].depth.as_slice().into();
        Ok(Some(Source::Predicted { values, intrinsics }))
    };
    frames.iter().enumerate().map(source).collect()
}
