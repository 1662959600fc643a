//! Photos seen by Depth Anything 3 or VGGT: depth and cameras.

use crate::{
    cameras::lenses,
    options::{ArithmeticOption, DEPTH_WEIGHTS, Quality, Size, refuse},
    photos,
    session::{Session, Stage},
    table::counted,
};
use clap::{Args, ValueEnum};
use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicUsize, Ordering},
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    depth::{self, DepthModel, DepthOptions, DepthPrediction},
    features::PixelValues,
    gpu::Device,
    ops::Precision,
    reconstruct::KvPool,
    types::{
        Camera, Fitting, Image, Masks, Pose, Scene, bounded_views,
        poses::{CaptureView, read_cloud},
        preprocess::{PixelMap, View},
    },
    weights::{DepthArchitecture, DepthCheckpoint},
};

pub const POINTS: usize = 200_000;

#[derive(Args, Clone, Copy, Debug, Default, PartialEq)]
pub struct CamerasFrom {
    /// Source of the cameras that a depth network estimates
    #[arg(long, alias = "by", value_enum, value_name = "HOW", default_value = "decoder")]
    camera_source: CameraSource,
    /// Estimate a focal length per photo, different along x and y; by default photos of equal size,
    /// camera and zoom share the median weighted by depth confidence
    #[arg(long)]
    per_view_focal: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum CameraSource {
    /// Camera decoder of the network
    #[default]
    Decoder,
    /// Rays of all pixels, with an estimated principal point
    Rays,
}

pub struct PredictorOptions<'a> {
    pub checkpoint: &'a DepthCheckpoint,
    /// Longer side of the network's input [default: the network's own].
    pub side: Option<u32>,
    pub masks: Option<Masks>,
    pub cameras: CamerasFrom,
    pub arithmetic: &'a ArithmeticOption,
    pub request: DepthOptions,
}

impl Quality {
    pub fn predictor_options<'a>(&'a self, checkpoint: &'a DepthCheckpoint) -> PredictorOptions<'a> {
        let (ratio, token_selection) = (self.ratio, self.token_selection.clone());
        let request = DepthOptions { ratio, token_selection, ..DepthOptions::default() };
        PredictorOptions { side: self.side(), request, ..PredictorOptions::of(checkpoint, &self.arithmetic) }
    }

    pub fn check_pixels(&self, checkpoint: &DepthCheckpoint) -> Result<()> {
        refuse("--kv-pool", self.kv_pool != KvPool::ALL, DEPTH_WEIGHTS, "weights of ZipSplat")?;
        let all = checkpoint.architecture().backbone.patch_size.pow(2) as u32;
        match self.kept() {
            Some(keep) if keep > all => {
                Err(Error::argument("--max-gaussians-per-patch", keep, format!("1 to {all}, the pixels of a patch")))
            }
            _ => Ok(()),
        }
    }
}

/// The network's own size of square photos.
pub fn square(checkpoint: &DepthCheckpoint) -> Size {
    let side = checkpoint.architecture().fitting().default_bound();
    Size(side, side)
}

pub fn check_finds_cameras(network: &DepthArchitecture) -> Result<()> {
    if network.multi_view() {
        return Ok(());
    }
    let found = format!("{}, which sees each photo by itself and has no camera decoder", network.name);
    let expected =
        "da3-small, da3-base, da3-large, da3-giant or vggt-1b, which see all photos at once; or known cameras";
    Err(Error::argument("network that finds cameras", found, expected))
}

pub struct PredictedViews {
    /// Photos with a camera, or all if the network estimates none.
    pub photos: Vec<PathBuf>,
    pub views: Vec<View>,
    pub depths: DepthPrediction,
    pub cameras: Option<Vec<Camera>>,
    pub lost: Vec<PathBuf>,
    pub notes: Vec<String>,
    pub network: String,
    pub precision: Precision,
    pub times: Vec<(&'static str, Duration)>,
}

pub struct DepthPredictor {
    model: DepthModel,
    pub precision: Precision,
    input: InputSize,
    cameras: CamerasFrom,
    pub request: DepthOptions,
    loading: Duration,
}

#[derive(Clone)]
pub struct PreparedPhotos {
    photos: Vec<PathBuf>,
    views: Vec<View>,
    known_cameras: Option<Vec<Camera>>,
}

impl<'a> PredictorOptions<'a> {
    pub fn of(checkpoint: &'a DepthCheckpoint, arithmetic: &'a ArithmeticOption) -> Self {
        let (cameras, request) = (CamerasFrom::default(), DepthOptions::default());
        Self { checkpoint, side: None, masks: None, cameras, arithmetic, request }
    }

    /// Patch tokens of photos with known cameras, and the cameras of the views.
    pub fn patch_tokens(
        self,
        session: &mut Session<'_>,
        photos: &[PathBuf],
        known: &[&CaptureView],
    ) -> Result<(Vec<Camera>, Vec<PixelValues>)> {
        let (prepared, _) = session.stage("load photos", |stage| self.read(photos, known, stage))?;
        let device = session.device()?;
        let DepthPredictor { model, request, .. } = self.open(session, &device)?;
        let images: Vec<Image> = prepared.views.into_iter().map(|view| view.image).collect();
        let tokens = |stage: &Stage<'_>| model.patch_tokens(&images, &request, |progress| stage.follow(progress));
        let (tokens, _) = session.stage("features", tokens)?;
        Ok((prepared.known_cameras.unwrap_or_default(), tokens))
    }

    /// Multi-view networks take the cameras of `known` frames, in their unit.
    pub fn ask(self, session: &mut Session<'_>, photos: &[PathBuf], known: &[&CaptureView]) -> Result<PredictedViews> {
        let (prepared, reading) = session.stage("load photos", |stage| self.read(photos, known, stage))?;
        let device = session.device()?;
        let predictor = self.open(session, &device)?;
        let (mut predicted, _) = session.stage("depth", |stage| predictor.predict(prepared, stage))?;
        session.notes(&predicted.notes);
        predicted.times.insert(0, ("load photos", reading));
        Ok(predicted)
    }

    pub fn read(&self, photos: &[PathBuf], known: &[&CaptureView], stage: &Stage<'_>) -> Result<PreparedPhotos> {
        read(self.input(), photos, known, self.masks.as_ref(), stage)
    }

    fn input(&self) -> InputSize {
        InputSize { side: self.side, fitting: self.checkpoint.architecture().fitting() }
    }

    pub fn open(self, session: &mut Session<'_>, device: &Device) -> Result<DepthPredictor> {
        let input = self.input();
        let Self { checkpoint, cameras, arithmetic, request, .. } = self;
        let (precision, arithmetic) = arithmetic.choose(session, device)?;
        let load =
            |stage: &Stage<'_>| DepthModel::from_checkpoint(device, checkpoint, arithmetic, |done| stage.at(done));
        let (model, loading) = session.stage("load weights", load)?;
        Ok(DepthPredictor { model, precision, input, cameras, request, loading })
    }
}

#[derive(Clone, Copy)]
struct InputSize {
    /// Longer side, if not the network's own.
    side: Option<u32>,
    fitting: Fitting,
}

fn read(
    InputSize { side, fitting }: InputSize,
    photos: &[PathBuf],
    known: &[&CaptureView],
    masks: Option<&Masks>,
    stage: &Stage<'_>,
) -> Result<PreparedPhotos> {
    let opened = AtomicUsize::new(0);
    // Photos of different sizes may be opened twice.
    let open = |i: usize| {
        let photo = photos::open(&photos[i], known.get(i), masks)?;
        let opened = 1 + opened.fetch_add(1, Ordering::Relaxed);
        stage.reach((opened as f64 / photos.len() as f64).min(1.0))?;
        Ok(photo)
    };
    let views = bounded_views(photos.len(), open, fitting, side)?;
    let camera = |(frame, view): (&&CaptureView, &View)| view.map.camera(&frame.camera, &frame.name);
    let cameras = || known.iter().zip(&views).map(camera).collect::<Result<Vec<_>>>();
    let known_cameras = (!known.is_empty()).then(cameras).transpose()?;
    Ok(PreparedPhotos { photos: photos.to_vec(), views, known_cameras })
}

impl PreparedPhotos {
    pub fn patches(&self, side: usize) -> usize {
        let of = |view: &View| (view.image.width as usize / side) * (view.image.height as usize / side);
        self.views.iter().map(of).sum()
    }
}

impl DepthPredictor {
    pub fn prepare(
        &self,
        photos: &[PathBuf],
        known: &[&CaptureView],
        masks: Option<&Masks>,
        stage: &Stage<'_>,
    ) -> Result<PreparedPhotos> {
        read(self.input, photos, known, masks, stage)
    }

    /// Prepares photos and predicts in one stage; returns its time.
    pub fn see(
        &self,
        session: &mut Session<'_>,
        photos: &[PathBuf],
        known: &[&CaptureView],
        masks: Option<&Masks>,
    ) -> Result<(PredictedViews, Duration)> {
        session.stage("depth", |stage| self.predict(self.prepare(photos, known, masks, stage)?, stage))
    }

    pub fn predict(&self, prepared: PreparedPhotos, stage: &Stage<'_>) -> Result<PredictedViews> {
        let (PreparedPhotos { photos, views, known_cameras }, begun) = (prepared, Instant::now());
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        // Single-view networks ignore cameras.
        let multi_view = self.model.architecture().multi_view();
        let request = DepthOptions { cameras: known_cameras.clone().filter(|_| multi_view), ..self.request.clone() };
        let mut depths = self.model.predict(&images, &request, |progress| stage.follow(progress))?;
        let seeing = begun.elapsed();
        let brought = request.cameras.as_ref().map_or(Ok(()), |cameras| depths.align_to_cameras(cameras));
        let mut predicted = PredictedViews {
            photos,
            views,
            depths,
            cameras: known_cameras,
            lost: Vec::new(),
            notes: brought.err().iter().map(|error| format!("lengths stay in the network's unit: {error}")).collect(),
            network: self.model.architecture().name.clone(),
            precision: self.precision,
            times: vec![("load weights", self.loading), ("depth", seeing)],
        };
        if predicted.cameras.is_none() && multi_view {
            predicted.find_cameras(self.cameras)?;
        }
        Ok(predicted)
    }
}

impl PredictedViews {
    fn find_cameras(&mut self, CamerasFrom { camera_source, per_view_focal }: CamerasFrom) -> Result<()> {
        let source = match camera_source {
            CameraSource::Decoder => depth::CameraSource::Decoder,
            CameraSource::Rays => depth::CameraSource::Rays,
        };
        let maps: Vec<PixelMap> = self.views.iter().map(|view| view.map).collect();
        let lenses = (!per_view_focal).then(|| lenses(&self.photos)).transpose()?;
        let found = self.depths.estimate_cameras(source, &maps, lenses.as_deref())?;
        let has: Vec<bool> = found.iter().map(Result::is_ok).collect();
        let (cameras, mut failed): (Vec<_>, Vec<_>) = found.into_iter().partition(Result::is_ok);
        if cameras.is_empty() {
            return Err(failed.pop().and_then(Result::err).unwrap_or(Error::Cancelled));
        }
        self.lost = keep(&mut self.photos, &has);
        keep(&mut self.views, &has);
        self.depths.keep_views(&has);
        self.cameras = Some(cameras.into_iter().flatten().collect());
        Ok(())
    }

    /// Scales single-view depth to a metric head's meters, or to the capture's `points` visible in
    /// each photo.
    pub fn scale(&mut self, metric: bool, points: Option<&Path>) -> Result<()> {
        let (network, Some(cameras)) = (&self.network, &self.cameras) else { return Ok(()) };
        if self.depths.views.iter().all(|view| view.sky.is_none()) {
            return refuse("--metric", metric, network, "a network that sees each photo by itself");
        }
        if metric {
            self.depths.to_meters(cameras);
            return Ok(());
        }
        let lacks = |found: String| {
            let expected = "points beside the cameras that every photo shows, as structure from motion leaves them";
            Error::argument(format!("scale of the depth that {network} says"), found, expected)
        };
        let cloud = read_cloud(points.ok_or_else(|| lacks("no points".into()))?)?;
        let failed = |view: usize| lacks(format!("none in {}", self.photos[view].display()));
        self.depths.scale_to(cameras, &cloud.positions).map_err(failed)
    }

    pub fn images(&self) -> Vec<Image> {
        self.views.iter().map(|view| view.image.clone()).collect()
    }

    pub fn frames(&self) -> Result<Vec<CaptureView>> {
        let frame = |(i, camera): (usize, &Camera)| {
            let photo = &self.photos[i];
            let upright = Camera { intrinsics: self.views[i].map.undo(&camera.intrinsics), ..*camera };
            let camera = Image::camera_as_stored(photo, &upright)?;
            Ok(CaptureView {
                name: photo.to_string_lossy().into_owned(),
                photo: Some(photo.clone()),
                camera,
                lens: None,
            })
        };
        self.cameras.iter().flatten().enumerate().map(frame).collect()
    }

    /// Confident pixels, at most `keep` per patch, in the frame of `first`.
    pub fn scene(&self, first: &Pose, keep: Option<u32>) -> Result<Scene> {
        let cameras: Vec<Camera> = self.cameras.iter().flatten().map(|camera| camera.relative_to(first)).collect();
        let images = self.images();
        let scene = self.depths.scene(&cameras, &images, keep.map(|keep| keep as usize));
        if scene.is_empty() {
            let found = format!("none of {}", counted(images.len(), "photo"));
            return Err(Error::argument("pixels of which the network is confident", found, "some"));
        }
        Ok(scene)
    }

    pub fn patches(&self) -> [usize; 2] {
        let [columns, rows] =
            [self.depths.width, self.depths.height].map(|side| side as usize / self.depths.patch_size);
        let all = self.views.len() * columns * rows;
        [self.depths.patches.as_ref().map_or(all, Vec::len), all]
    }

    /// At most `most`; none without cameras.
    pub fn points(&self, most: usize) -> Vec<([f32; 3], [u8; 3])> {
        let Some(cameras) = &self.cameras else { return Vec::new() };
        self.depths.points(cameras, &self.images(), most)
    }
}

fn keep<T>(list: &mut Vec<T>, kept: &[bool]) -> Vec<T> {
    let (stays, goes): (Vec<_>, Vec<_>) = std::mem::take(list).into_iter().zip(kept).partition(|(_, kept)| **kept);
    *list = stays.into_iter().map(|(item, _)| item).collect();
    goes.into_iter().map(|(item, _)| item).collect()
}
