//! Values of photos, and features beside a scene.

use crate::{
    cameras::{Similarity, WorldPhoto, to_scene},
    depth::PredictorOptions,
    npy,
    options::{ArithmeticOption, Network, Size, Weights},
    session::Session,
    stamp::hex,
    table::counted,
    views::Crop,
};
use clap::Args;
use png::ColorType;
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use sha2::{Digest, Sha256};
use std::{
    collections::HashMap,
    io::BufReader,
    path::{Path, PathBuf},
};
use zipsplat::{
    Camera, Error, Result, Scene,
    features::{Features, Lifted, PixelValues},
    reconstruct::ReconstructOptions,
    types::{
        Intrinsics, Lens, World, named_after, open_file,
        poses::{Capture, CaptureView},
        write_atomic,
    },
    weights::Checkpoint,
};

const LARGEST: u32 = 1600;
/// The only entry of the metadata: several would have no fixed order.
const SCENE: &str = "zipsplat.scene_sha256";

#[derive(Args)]
pub struct PosedPhotos {
    /// Cameras of the photos: transforms.json or a COLMAP model's folder
    #[arg(long, value_name = "PATH")]
    cameras: PathBuf,
    #[command(flatten)]
    world_photo: WorldPhoto,
}

impl PosedPhotos {
    pub fn open(&self, session: &mut Session<'_>, world: Option<&World>) -> Result<(Capture, Similarity)> {
        let capture = Capture::open(&self.cameras)?;
        session.notes(&capture.warnings);
        let (to_scene, note) = to_scene(self.world_photo.relative_to.as_deref(), &capture, world, &self.cameras)?;
        session.notes(note);
        Ok((capture, to_scene))
    }
}

pub fn values_file(folder: &Path, photo: &str, extensions: &[&str]) -> Option<PathBuf> {
    let mut files = extensions.iter().flat_map(|extension| named_after(folder, Path::new(photo), extension));
    files.find(|file| file.is_file())
}

/// The aspect ratio may differ by 1 %, or by a cell of a coarse grid.
pub fn check_shape(file: &Path, [width, height]: [u32; 2], photo: &Intrinsics) -> Result<()> {
    let [across, down] = [(width, photo.height), (height, photo.width)].map(|(a, b)| f64::from(a) * f64::from(b));
    if (across - down).abs() <= (0.01 * down).max(f64::from(photo.width.max(photo.height))) {
        return Ok(());
    }
    let expected = format!("the shape of its photo, {}x{}", photo.width, photo.height);
    Err(Error::argument(file.display().to_string(), format!("{width}x{height}"), expected))
}

/// Photos of equal names cannot share a file.
pub fn values_files<'a>(
    folder: &Path,
    frames: &[&'a CaptureView],
    extensions: &[&str],
) -> Result<Vec<Option<PathBuf>>> {
    let mut photo_of: HashMap<PathBuf, &str> = HashMap::new();
    let file = |frame: &&'a CaptureView| {
        let Some(file) = values_file(folder, &frame.name, extensions) else { return Ok(None) };
        if let Some(other) = photo_of.insert(file.clone(), &frame.name).filter(|other| *other != frame.name) {
            let found = format!("{}, as of {other}", file.display());
            return Err(Error::argument(format!("values of {}", frame.name), found, "a file of its own"));
        }
        Ok(Some(file))
    };
    frames.iter().map(file).collect()
}

struct ValueFile {
    path: PathBuf,
    camera: Camera,
    lens: Option<Lens>,
    /// As stored.
    photo: Intrinsics,
}

pub struct ValueFiles(Vec<ValueFile>);

impl ValueFiles {
    pub fn find(session: &mut Session<'_>, folder: &Path, photos: &PosedPhotos, world: Option<&World>) -> Result<Self> {
        let (capture, to_scene) = photos.open(session, world)?;
        let mut files = Vec::new();
        let frames: Vec<&CaptureView> = capture.frames.iter().collect();
        for (frame, path) in frames.iter().zip(values_files(folder, &frames, &["npy", "png"])?) {
            let Some(path) = path else { continue };
            let (camera, lens) = (fitted(&to_scene.apply(&frame.camera)), frame.lens);
            let photo = lens.map_or(frame.camera.intrinsics, |lens| lens.intrinsics);
            files.push(ValueFile { path, camera, lens, photo });
        }
        if files.is_empty() {
            let expected = format!("NAME.npy or NAME.png for photos of {}", photos.cameras.display());
            return Err(Error::argument(folder.display().to_string(), "no values", expected));
        }
        if files.len() < capture.frames.len() {
            let (found, all) = (files.len(), capture.frames.len());
            session.note(format!("{}: values of {found} of {all} photos", folder.display()));
        }
        Ok(Self(files))
    }

    pub fn cameras(&self) -> Vec<Camera> {
        self.0.iter().map(|file| file.camera).collect()
    }

    /// Reads the values of a photo, without its lens's distortion: the nearest, or NaN outside.
    pub fn read(&self, i: usize, labels: Option<usize>) -> Result<PixelValues> {
        let ValueFile { path, lens, photo, .. } = &self.0[i];
        let values = read_values(path, labels)?;
        check_shape(path, [values.width, values.height], photo)?;
        let Some(lens) = lens else { return Ok(values) };
        let PixelValues { width, height, channels, values } = values;
        let (place, [columns, rows]) = (lens.places([width, height])?, lens.view_size([width, height]));
        let empty = vec![f32::NAN; channels];
        let at = |cell: usize| {
            let (x, y) = place(cell / columns as usize, cell % columns as usize);
            let is_inside = x >= 0.0 && y >= 0.0 && x < f64::from(width) && y < f64::from(height);
            let source = if is_inside { y as usize * width as usize + x as usize } else { usize::MAX };
            values.get(source.saturating_mul(channels)..).and_then(|row| row.get(..channels)).unwrap_or(&empty)
        };
        let values = (0..columns as usize * rows as usize).flat_map(|cell| at(cell).to_vec()).collect();
        Ok(PixelValues { width: columns, height: rows, channels, values })
    }
}

/// Standardizes each channel: otherwise few decide all cosines.
fn standardize(views: &mut [PixelValues]) {
    let channels = views.first().map_or(0, |view| view.channels);
    let count = views.iter().map(|view| view.values.len()).sum::<usize>() as f64 / channels.max(1) as f64;
    for channel in 0..channels {
        let values = || views.iter().flat_map(|view| view.values[channel..].iter().step_by(channels));
        let mean = values().map(|value| f64::from(*value)).sum::<f64>() / count;
        let variance = values().map(|value| (f64::from(*value) - mean).powi(2)).sum::<f64>() / count;
        let scale = variance.sqrt().max(f64::MIN_POSITIVE);
        let all = views.iter_mut().flat_map(|view| view.values[channel..].iter_mut().step_by(channels));
        all.for_each(|value| *value = ((f64::from(*value) - mean) / scale) as f32);
    }
}

/// Standardized patch tokens of at most `views` evenly spaced photos, and the cameras of the
/// cropped photos.
pub fn of_network(
    session: &mut Session<'_>,
    weights: &Weights,
    views: usize,
    photos: &PosedPhotos,
    world: Option<&World>,
) -> Result<(Vec<Camera>, Vec<PixelValues>)> {
    let (capture, to_scene) = photos.open(session, world)?;
    let mut frames: Vec<&CaptureView> = capture.frames.iter().filter(|frame| frame.photo.is_some()).collect();
    let count = views.min(frames.len());
    frames = (0..count).map(|i| frames[i * frames.len() / count]).collect();
    let paths: Vec<PathBuf> = frames.iter().filter_map(|frame| frame.photo.clone()).collect();
    if paths.is_empty() {
        return Err(Error::argument(photos.cameras.display().to_string(), "no photos", "the photos of the cameras"));
    }
    let (cameras, mut tokens) = match weights.open_network()? {
        Network::Tokens(checkpoint) => tokens_of(session, &checkpoint, &paths, &frames)?,
        Network::Pixels(checkpoint) => {
            let arithmetic = ArithmeticOption::default();
            PredictorOptions::of(&checkpoint, &arithmetic).patch_tokens(session, &paths, &frames)?
        }
    };
    standardize(&mut tokens);
    Ok((cameras.iter().map(|camera| to_scene.apply(camera)).collect(), tokens))
}

fn tokens_of(
    session: &mut Session<'_>,
    checkpoint: &Checkpoint,
    paths: &[PathBuf],
    frames: &[&CaptureView],
) -> Result<(Vec<Camera>, Vec<PixelValues>)> {
    let size = Size::or_best(None, checkpoint);
    let device = session.device()?;
    let (_, arithmetic) = ArithmeticOption::default().choose(session, &device)?;
    let (seen, _) = session.stage("load photos", |stage| Crop::Center.load(paths, frames, None, size, stage))?;
    let (model, _) = session.load_model(&device, checkpoint, arithmetic)?;
    let (features, _) = session.stage("features", |stage| {
        model.features(&seen.images, &ReconstructOptions::default(), |progress| stage.follow(progress))
    })?;
    let first = frames[0].camera.pose;
    let here = |camera: Camera| Camera { pose: first.compose(&camera.pose), ..camera };
    Ok((seen.cameras.into_iter().map(here).collect(), features.patch_tokens()?))
}

/// `[height, width, channels]` values, or a picture: a mask from 0 to 1, or a channel per label,
/// where other values do not count.
fn read_values(path: &Path, labels: Option<usize>) -> Result<PixelValues> {
    if path.extension().is_some_and(|ext| ext == "npy") {
        let ([height, width, channels], values) = npy::read_array(path, "height, width, channels")?;
        return Ok(PixelValues { width, height, channels: channels as usize, values });
    }
    let Some(count) = labels else {
        let picture = image::open(path).map_err(|error| Error::format(path, None, error.to_string()))?.into_luma8();
        let (width, height) = picture.dimensions();
        let values = picture.into_raw().into_iter().map(|value| f32::from(value) / 255.0).collect();
        return Ok(PixelValues { width, height, channels: 1, values });
    };
    let ([width, height], picture) = read_labels(path)?;
    let channel =
        |label: usize, found: usize| if found < count { f32::from(u8::from(label == found)) } else { f32::NAN };
    let values = picture.into_iter().flat_map(|found| (0..count).map(move |label| channel(label, found))).collect();
    Ok(PixelValues { width, height, channels: count, values })
}

/// Gray levels or palette indices of a PNG, as stored.
fn read_labels(path: &Path) -> Result<([u32; 2], Vec<usize>)> {
    let malformed = |error: png::DecodingError| Error::format(path, None, error.to_string());
    let mut decoder = png::Decoder::new(BufReader::new(open_file(path)?));
    decoder.set_transformations(png::Transformations::IDENTITY);
    let mut reader = decoder.read_info().map_err(malformed)?;
    let (color, depth) = reader.output_color_type();
    if !matches!(color, ColorType::Grayscale | ColorType::Indexed) {
        return Err(Error::format(path, None, format!("found {color:?}, expected a gray or palette PNG of labels")));
    }
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let png::OutputInfo { width, height, line_size, .. } = reader.next_frame(&mut bytes).map_err(malformed)?;
    let label = |line: &[u8], x: usize| match depth as usize {
        16 => usize::from(u16::from_be_bytes([line[2 * x], line[2 * x + 1]])),
        bits => usize::from(line[x * bits / 8] >> (8 - bits - x * bits % 8)) & ((1 << bits) - 1),
    };
    let lines = bytes.chunks_exact(line_size).take(height as usize);
    Ok(([width, height], lines.flat_map(|line| (0..width as usize).map(move |x| label(line, x))).collect()))
}

pub fn save(path: &Path, lifted: &Lifted, scene: &Scene) -> Result<()> {
    let Features { values, channels, .. } = &lifted.features;
    let rows = lifted.weights.len();
    let view = |shape: Vec<usize>, values| TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(values));
    let tensors = [("features", view(vec![rows, *channels], values)), ("weights", view(vec![rows], &lifted.weights))]
        .map(|(name, tensor)| (name, tensor.expect("whole values")));
    let metadata = HashMap::from([(SCENE.to_owned(), hash(scene))]);
    let bytes = safetensors::serialize(tensors, Some(metadata))
        .map_err(|error| Error::format(path, None, error.to_string()))?;
    write_atomic(path, |out| out.write_all(&bytes))
}

pub fn check_count(features: &[PathBuf], scenes: &[PathBuf]) -> Result<()> {
    if features.is_empty() || features.len() == scenes.len() {
        return Ok(());
    }
    let expected = format!("one for each of {}", counted(scenes.len(), "scene"));
    Err(Error::argument("--features", counted(features.len(), "file"), expected))
}

pub fn open(path: &Path, scene: &Scene) -> Result<Lifted> {
    let bytes = std::fs::read(path).map_err(|error| Error::io(path, error))?;
    let malformed = |reason: String| Error::format(path, None, reason);
    let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|error| malformed(error.to_string()))?;
    let stated = metadata.metadata().clone().unwrap_or_default();
    let stated_hash = stated.get(SCENE).map_or("", String::as_str);
    if stated_hash != hash(scene) {
        return Err(malformed(format!("found features of scene {stated_hash:.12}, expected {:.12}", hash(scene))));
    }
    let file = SafeTensors::deserialize(&bytes).map_err(|error| malformed(error.to_string()))?;
    let tensor = |name: &str| {
        let tensor = file.tensor(name).map_err(|error| malformed(error.to_string()))?;
        let (values, _) = tensor.data().as_chunks::<4>();
        let width = tensor.shape().get(1).copied().unwrap_or(1);
        Ok((values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect::<Vec<f32>>(), width))
    };
    let ((values, channels), (weights, _)) = (tensor("features")?, tensor("weights")?);
    let features = Features { values, channels, group: scene.len().checked_div(weights.len()).unwrap_or(0) };
    features.validate(scene)?;
    Ok(Lifted { features, weights })
}

fn hash(scene: &Scene) -> String {
    let mut hash = Sha256::new();
    let fields = [scene.means.as_flattened(), scene.scales.as_flattened(), scene.quats.as_flattened()];
    for values in fields.into_iter().chain([&scene.opacities[..], scene.sh_coeffs.as_flattened()]) {
        hash.update(bytemuck::cast_slice(values));
    }
    hex(&hash.finalize())
}

fn fitted(camera: &Camera) -> Camera {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let factor = (f64::from(LARGEST) / f64::from(width.max(height))).min(1.0);
    let [width, height] = [width, height].map(|side| ((f64::from(side) * factor).round() as u32).max(1));
    Camera { intrinsics: camera.intrinsics.resized(width, height), ..*camera }
}
