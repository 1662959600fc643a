use super::{
    Live,
    cameras::{InputCamera, QUALITY},
    live::Source,
    page::View,
};
use crate::{
    cameras::{Finding, KnownCameras},
    capture::scale_warning,
    html::data_url,
    options::{Quality, Weights, parse_length},
    photos::{self, Photographed, Reading},
    refinement::RefineArgs,
    session::Session,
    table::counted,
    video::FrameFolder,
    views::{CropOption, Views},
};
use clap::Args;
use std::{
    path::{Path, PathBuf},
    sync::{Mutex, atomic::AtomicU64},
};
use zipsplat::{
    Error, Result,
    gpu::Progress,
    reconstruct::{MAX_VIEWS, Ratio},
    types::{
        Camera, PointCloud, Pose,
        poses::{Capture, CaptureView, read_cloud},
    },
    weights::Checkpoint,
};

#[derive(Args)]
#[command(next_help_heading = "Options of photos")]
pub struct FromPhotos {
    #[command(flatten)]
    pub reading: Reading,
    #[command(flatten)]
    pub weights: Weights,
    #[command(flatten)]
    pub quality: Quality,
    #[command(flatten)]
    pub(super) crop: CropOption,
    /// Largest number of photos or video frames, evenly spaced [default: all photos, 24 frames of a
    /// video]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=MAX_VIEWS as i64))]
    views: Option<u32>,
    #[command(flatten)]
    pub(super) finding: Finding,
    /// Length in the cameras' unit that is 1 for the network, as in reconstruct
    #[arg(long, alias = "unit", value_name = "LENGTH", requires = "cameras", value_parser = parse_length)]
    pub(super) scene_scale: Option<f64>,
    /// Ratios of the scenes in a written page, and of pixel scenes, at most 8 [default:
    /// 1,0.5,0.25,0.1 without duplicates]
    #[arg(long, value_name = "R,R,..", value_delimiter = ',')]
    pub ratios: Vec<f64>,
    #[command(flatten)]
    pub(super) refine: RefineArgs,
}

/// Default and maximum number.
const RATIOS: [f64; 4] = [1.0, 0.5, 0.25, 0.1];
const MOST_RATIOS: usize = 8;

pub struct Ready<'a> {
    pub live: Live<'a>,
    /// In the scene's world.
    pub cameras: Vec<InputCamera>,
    pub(super) names: Vec<String>,
    pub(super) photos: Vec<PathBuf>,
    pub(super) frames: Vec<CaptureView>,
    pub(super) cloud: Option<PointCloud>,
    _folder: Option<FrameFolder>,
}

impl FromPhotos {
    pub(super) fn photographed(
        &self,
        session: &mut Session<'_>,
        paths: &[PathBuf],
        poses: Option<&Path>,
    ) -> Result<Photographed> {
        let unposed = poses.is_none_or(KnownCameras::to_find).then_some(&self.finding.search.masks);
        let (photos, folder) = self.reading.list(session, paths, self.views, unposed, None)?;
        let mut known = poses.map(|poses| KnownCameras::of(session, poses, &photos, &self.finding)).transpose()?;
        let views = self.views.filter(|_| unposed.is_none());
        let photos = photos::kept(session, photos, known.as_mut(), views)?;
        self.finding.masks().map_or(Ok(()), |masks| masks.check(&photos))?;
        Ok(Photographed { photos, known, folder })
    }

    /// First given option, for rejection with scene files.
    pub fn given(&self) -> Option<&'static str> {
        let options = [
            ("--weights", !self.weights.is_builtin()),
            ("--ratio", self.quality.ratio != Ratio::Fixed(1.0)),
            ("--ratios", !self.ratios.is_empty()),
            ("--views", self.views.is_some()),
            ("--scene-scale", self.scene_scale.is_some()),
            ("--refine", self.refines()),
            ("--masks", self.finding.masks().is_some()),
            ("--camera-model", self.reading.camera_model.is_some()),
        ];
        options.into_iter().find(|(_, given)| *given).map(|(option, _)| option)
    }

    pub fn refines(&self) -> bool {
        self.refine.steps().is_some()
    }

    /// Runs the network up to its features.
    pub fn prepare<'a, 's: 'a>(
        &'a self,
        session: &mut Session<'s>,
        checkpoint: Checkpoint,
        paths: &[PathBuf],
        poses: Option<&Path>,
    ) -> Result<Ready<'a>> {
        let cancelled = session.cancelled();
        self.refine.check()?;
        session.notes(checkpoint.notes());
        self.quality.check(checkpoint.architecture())?;
        let Photographed { photos, known, folder } = self.photographed(session, paths, poses)?;
        let poses = known.as_ref().map(|known| &known.poses);
        let (size, crop) = (self.quality.size_for(&checkpoint), self.crop.crop);
        crop.check(size, poses.is_some())?;
        session.notes(self.quality.doubt_size(&checkpoint));
        let frames = poses.map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        let count = crop.count(&photos, &frames)?;
        self.quality.shape(checkpoint.architecture(), count, size, poses.is_some())?;
        let masks = self.finding.masks();
        let device = session.device()?;
        let (precision, arithmetic) = self.quality.arithmetic.choose(session, &device)?;
        let (views, _) =
            session.stage("load photos", |stage| crop.load(&photos, &frames, masks.as_ref(), size, stage))?;
        let Views { images, cameras, note } = views;
        session.notes(note);
        let unit = self.length(session, poses, &cameras, &frames)?;
        let (cameras, turned) = crop.network_cameras(cameras);
        let (model, _) = session.load_model(&device, &checkpoint, arithmetic)?;
        let request = self.quality.request(cameras, unit);
        let (features, _) = session.stage("backbone", |stage| {
            model.features(&images, &request, |progress: Progress<'_>| stage.at(progress.fraction))
        })?;
        let cloud = poses.and_then(|poses| poses.points.as_ref()).filter(|_| self.refines());
        let cloud = cloud.map(read_cloud).transpose()?;
        let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut names = Vec::new();
        for (i, photo) in photos.iter().enumerate() {
            // Crops of one photo are consecutive.
            let views = crop.count(std::slice::from_ref(photo), frames.get(i..=i).unwrap_or_default())?;
            names.extend(std::iter::repeat_n(name(photo), views));
        }
        let live = Live {
            device,
            checkpoint,
            quality: &self.quality,
            images,
            request,
            turned,
            name: counted(photos.len(), "photo"),
            sources: Mutex::new(vec![Source { precision, model, features }]),
            latest: AtomicU64::new(0),
            cancelled,
        };
        let cameras = input_cameras(&photos, &frames);
        let frames = frames.into_iter().cloned().collect();
        Ok(Ready { live, cameras, names, photos, frames, cloud, _folder: folder })
    }

    fn length(
        &self,
        session: &mut Session<'_>,
        poses: Option<&Capture>,
        cameras: &[Camera],
        frames: &[&CaptureView],
    ) -> Result<f64> {
        let (Some(poses), Some(first)) = (poses, frames.first()) else { return Ok(1.0) };
        let unit = poses.scene_scale(self.scene_scale, cameras, &first.camera.pose)?;
        session.notes(scale_warning(&unit));
        Ok(unit.length)
    }

    /// Descending, without equal numbers of tokens.
    pub fn ratios(&self, tokens: usize) -> Result<Vec<f64>> {
        let mut ratios = if self.ratios.is_empty() { RATIOS.to_vec() } else { self.ratios.clone() };
        if let Some(wrong) = ratios.iter().find(|ratio| !(**ratio > 0.0 && **ratio <= 1.0)) {
            return Err(Error::argument("--ratios", wrong, "numbers in (0, 1]"));
        }
        if ratios.len() > MOST_RATIOS {
            return Err(Error::argument("--ratios", ratios.len(), format!("at most {MOST_RATIOS}")));
        }
        ratios.sort_by(|a, b| b.total_cmp(a));
        ratios.dedup_by_key(|ratio| ((*ratio * tokens as f64) as usize).max(1));
        Ok(ratios)
    }
}

impl Ready<'_> {
    pub fn views(&self, within: bool) -> Result<Vec<View>> {
        let view = |(i, name): (usize, &String)| {
            let photo = if within { data_url(&self.view(i)?) } else { format!("view/{i}") };
            Ok(View { name: name.clone(), photo })
        };
        self.names.iter().enumerate().map(view).collect()
    }

    pub fn view(&self, index: usize) -> Result<Vec<u8>> {
        self.live.images[index].jpeg(QUALITY)
    }
}

pub(super) fn input_cameras(photos: &[PathBuf], frames: &[&CaptureView]) -> Vec<InputCamera> {
    let world = frames.first().map_or(Pose::IDENTITY, |first| first.camera.pose);
    let camera = |(photo, frame): (&PathBuf, &&CaptureView)| {
        InputCamera::new((*frame).clone(), &frame.camera.pose.relative_to(&world), Some(photo.clone()))
    };
    photos.iter().zip(frames).map(camera).collect()
}
