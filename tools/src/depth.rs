//! Photos as a network of Depth Anything 3 sees them: their depth, and where they were taken.

use crate::{
    cameras::lenses,
    options::{ArithmeticOption, refuse},
    photos,
    session::{Session, Stage},
};
use clap::{Args, ValueEnum};
use std::{
    path::{Path, PathBuf},
    time::Duration,
};
use zipsplat::{
    Error, Result,
    cameras::share_focal_lengths,
    depth::{DepthModel, DepthRequest, DepthView, Depths},
    gpu::Progress,
    ops::Precision,
    types::{
        Camera, DEFAULT_BOUND, Image, bounded_views,
        poses::{Frame, read_cloud},
        preprocess::View,
    },
    weights::DepthCheckpoint,
};

/// Points at most, where nobody says.
pub const POINTS: usize = 200_000;

/// How the cameras of photos follow from what a network says.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct CamerasFrom {
    /// Source of the cameras that a network of Depth Anything 3 finds
    #[arg(long, value_enum, value_name = "HOW", default_value = "decoder")]
    by: By,
    /// Focal lengths of those cameras
    #[arg(long, value_enum, value_name = "WHOSE", default_value = "shared")]
    focal_lengths: FocalLengths,
}

/// The source of cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum By {
    /// The network's camera decoder
    #[default]
    Decoder,
    /// The rays of all pixels, with a principal point of their own
    Rays,
}

/// The owner of a focal length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum FocalLengths {
    /// Photos of one size, camera and zoom have one: the median, weighted by how confident the network is of each photo's depth
    #[default]
    Shared,
    /// Each photo has its own, and another one along y than along x
    Own,
}

/// A question to a network.
pub struct Question<'a> {
    pub checkpoint: &'a DepthCheckpoint,
    /// Longer side of the photos as the network sees them [default: as Depth Anything 3 is used].
    pub side: Option<u32>,
    pub cameras: CamerasFrom,
    pub arithmetic: &'a ArithmeticOption,
    pub request: DepthRequest,
}

/// Photos, what a network saw of them, and what it said.
pub struct Seen {
    /// The photos that have a camera, or all where a network finds none.
    pub photos: Vec<PathBuf>,
    /// As the network sees them.
    pub views: Vec<View>,
    pub depths: Depths,
    /// The cameras of the views, where they are known or the network finds them.
    pub cameras: Option<Vec<Camera>>,
    /// The photos for which there is none.
    pub lost: Vec<PathBuf>,
    /// The network's name.
    pub network: String,
    /// The arithmetic that it computed in.
    pub precision: Precision,
    /// Time of each step.
    pub times: Vec<(&'static str, Duration)>,
}

impl Question<'_> {
    /// Shows photos to the network. Those with frames have known cameras, which a network that sees all photos at once is told; lengths
    /// are then in their unit.
    ///
    /// # Errors
    /// Those of photos that cannot be read, and of [`DepthModel::depths`]; [`Error::Argument`] where no photo's rays have a camera.
    pub fn ask(self, session: &mut Session<'_>, photos: &[PathBuf], known: &[&Frame]) -> Result<Seen> {
        let (read, reading) =
            session.stage("load photos", |stage| photos::read(photos, known, stage, |_, photo| Ok(photo)))?;
        let views = bounded_views(&read, self.side.unwrap_or(DEFAULT_BOUND))?;
        drop(read);
        let told = (!known.is_empty()).then(|| of_views(known, &views)).transpose()?;
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        let device = session.device()?;
        let (precision, arithmetic) = self.arithmetic.choose(session, &device)?;
        let load = |stage: &Stage<'_>| DepthModel::load(&device, self.checkpoint, arithmetic, |done| stage.at(done));
        let (model, loading) = session.stage("load weights", load)?;
        // Who sees each photo by itself has no use for cameras.
        let multi_view = model.architecture().multi_view();
        let request = DepthRequest { cameras: told.clone().filter(|_| multi_view), ..self.request };
        let (mut depths, seeing) = session.stage("depth", |stage| {
            model.depths(&images, &request, |progress: Progress<'_>| {
                stage.name(progress.scope);
                stage.at(progress.fraction)
            })
        })?;
        if let Some(cameras) = &request.cameras
            && let Err(error) = depths.bring_to(cameras)
        {
            session.note(format!("lengths stay in the network's unit: {error}"));
        }
        let mut seen = Seen {
            photos: photos.to_vec(),
            views,
            depths,
            cameras: told,
            lost: Vec::new(),
            network: self.checkpoint.architecture().name.clone(),
            precision,
            times: vec![("load photos", reading), ("load weights", loading), ("depth", seeing)],
        };
        if seen.cameras.is_none() && multi_view {
            seen.find_cameras(self.cameras)?;
        }
        Ok(seen)
    }
}

impl Seen {
    /// Takes the cameras from what the network says. Photos without one are left out.
    fn find_cameras(&mut self, CamerasFrom { by, focal_lengths }: CamerasFrom) -> Result<()> {
        let found: Vec<Result<Camera>> = match by {
            By::Decoder => self.depths.cameras()?.into_iter().map(Ok).collect(),
            By::Rays => self.depths.cameras_of_rays()?.into_iter().map(|found| Ok(found?.camera)).collect(),
        };
        let has: Vec<bool> = found.iter().map(Result::is_ok).collect();
        let (cameras, mut failed): (Vec<_>, Vec<_>) = found.into_iter().partition(Result::is_ok);
        if cameras.is_empty() {
            return Err(failed.pop().and_then(Result::err).unwrap_or(Error::Cancelled));
        }
        self.lost = keep(&mut self.photos, &has);
        keep(&mut self.views, &has);
        self.depths.keep_views(&has);
        let mut cameras: Vec<Camera> = cameras.into_iter().flatten().collect();
        if focal_lengths == FocalLengths::Shared {
            let maps: Vec<_> = self.views.iter().map(|view| view.map).collect();
            let weights: Vec<_> = self.depths.views.iter().map(DepthView::mean_confidence).collect();
            share_focal_lengths(&mut cameras, &maps, &lenses(&self.photos)?, &weights);
        }
        self.cameras = Some(cameras);
        Ok(())
    }

    /// Brings the depth of photos that a network saw each by itself to one unit: metres of a metric head, or that of `points` beside their
    /// cameras, by those that each photo shows. Depth of photos that were seen at once stays as it is.
    ///
    /// # Errors
    /// [`Error::Argument`] where nothing tells the unit, or there are no cameras; those of points that cannot be read.
    pub fn scale(&mut self, metres: bool, points: Option<&Path>) -> Result<()> {
        let (network, Some(cameras)) = (&self.network, &self.cameras) else { return Ok(()) };
        if self.depths.views.iter().all(|view| view.sky.is_none()) {
            return refuse("--metres", metres, network, "a network that sees each photo by itself");
        }
        if metres {
            self.depths.to_metres(cameras);
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

    /// The pictures that the network saw.
    pub fn images(&self) -> Vec<Image> {
        self.views.iter().map(|view| view.image.clone()).collect()
    }

    /// The cameras of the photos as they are stored, under the photos' paths; none where the network finds none.
    ///
    /// # Errors
    /// Where a photo's orientation is none of a camera's.
    pub fn frames(&self) -> Result<Vec<Frame>> {
        let frame = |(i, camera): (usize, &Camera)| {
            let photo = &self.photos[i];
            let upright = Camera { intrinsics: self.views[i].map.undo(&camera.intrinsics), ..*camera };
            let camera = Image::camera_as_stored(photo, &upright)?;
            Ok(Frame { name: photo.to_string_lossy().into_owned(), photo: Some(photo.clone()), camera, lens: None })
        };
        self.cameras.iter().flatten().enumerate().map(frame).collect()
    }

    /// The points of pixels that the network is confident of, at most so many; none where there are no cameras.
    pub fn points(&self, most: usize) -> Vec<([f32; 3], [u8; 3])> {
        let Some(cameras) = &self.cameras else { return Vec::new() };
        self.depths.points(cameras, &self.images(), most)
    }
}

/// Leaves of a list only what is `kept`, and gives the rest.
fn keep<T>(list: &mut Vec<T>, kept: &[bool]) -> Vec<T> {
    let (stays, goes): (Vec<_>, Vec<_>) = std::mem::take(list).into_iter().zip(kept).partition(|(_, kept)| **kept);
    *list = stays.into_iter().map(|(item, _)| item).collect();
    goes.into_iter().map(|(item, _)| item).collect()
}

/// Known cameras of photos as those of their views.
fn of_views(frames: &[&Frame], views: &[View]) -> Result<Vec<Camera>> {
    let camera = |(frame, view): (&&Frame, &View)| {
        Ok(Camera { intrinsics: view.map.apply(&frame.camera.intrinsics, &frame.name)?, ..frame.camera })
    };
    frames.iter().zip(views).map(camera).collect()
}
