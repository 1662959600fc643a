//! Photos as a network of Depth Anything 3 sees them: their depth, and where they were taken.

use crate::{
    cameras::lenses,
    options::{ArithmeticOption, Quality, refuse},
    photos,
    session::{Session, Stage},
    table::counted,
};
use clap::{Args, ValueEnum};
use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    cameras::share_focal_lengths,
    depth::{DepthModel, DepthRequest, DepthView, Depths},
    gpu::{Device, Progress},
    ops::Precision,
    reconstruct::Ratio,
    types::{
        Camera, DEFAULT_BOUND, Image, Pose, Scene, bounded_views,
        poses::{Frame, read_cloud},
        preprocess::View,
    },
    weights::{DepthArchitecture, DepthCheckpoint},
};

/// Points at most, where nobody says.
pub const POINTS: usize = 200_000;

/// How the cameras of photos follow from what a network says.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct CamerasFrom {
    /// Source of the cameras that a network of Depth Anything 3 finds
    #[arg(long, alias = "camera-source", value_enum, value_name = "HOW", default_value = "decoder")]
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

impl Quality {
    /// The question that a network is asked for a scene.
    pub fn question<'a>(&'a self, checkpoint: &'a DepthCheckpoint) -> Question<'a> {
        Question {
            checkpoint,
            side: self.side(),
            cameras: CamerasFrom::default(),
            arithmetic: &self.arithmetic,
            request: DepthRequest { ratio: self.ratio, selection: self.select.clone(), ..DepthRequest::default() },
        }
    }

    /// As [`Quality::check`], where each pixel becomes a Gaussian.
    ///
    /// # Errors
    /// [`Error::Argument`] for more Gaussians of a patch than it has pixels.
    pub fn check_pixels(&self, checkpoint: &DepthCheckpoint) -> Result<()> {
        refuse("--pool", self.pool != 1, "weights of Depth Anything 3", "weights of ZipSplat")?;
        let all = checkpoint.architecture().backbone.patch.pow(2) as u32;
        match self.kept() {
            Some(keep) if keep > all => {
                Err(Error::argument("--keep", keep, format!("1 to {all}, the pixels of a patch")))
            }
            _ => Ok(()),
        }
    }
}

/// Refuses a network that finds no cameras.
///
/// # Errors
/// [`Error::Argument`] for one that sees each photo by itself.
pub fn check_finds_cameras(network: &DepthArchitecture) -> Result<()> {
    if network.multi_view() {
        return Ok(());
    }
    let found = format!("{}, which sees each photo by itself and has no camera decoder", network.name);
    let expected = "da3-small, da3-base, da3-large or da3-giant, which see all photos at once; or known cameras";
    Err(Error::argument("network that finds cameras", found, expected))
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
    /// Whatever a user should know of it.
    pub notes: Vec<String>,
    /// The network's name.
    pub network: String,
    /// The arithmetic that it computed in.
    pub precision: Precision,
    /// Time of each step.
    pub times: Vec<(&'static str, Duration)>,
}

/// A network on a device, and what it is asked.
pub struct Seer {
    model: DepthModel,
    precision: Precision,
    side: Option<u32>,
    cameras: CamerasFrom,
    request: DepthRequest,
    loading: Duration,
}

/// Photos as a network is shown them.
#[derive(Clone)]
pub struct Shown {
    photos: Vec<PathBuf>,
    views: Vec<View>,
    /// Their cameras, where they are known.
    told: Option<Vec<Camera>>,
}

impl Question<'_> {
    /// Shows photos to the network. Those with frames have known cameras, which a network that sees all photos at once is told; lengths
    /// are then in their unit.
    ///
    /// # Errors
    /// Errors of photos that cannot be read, and of [`DepthModel::depths`]; [`Error::Argument`] where no photo's rays have a camera.
    pub fn ask(self, session: &mut Session<'_>, photos: &[PathBuf], known: &[&Frame]) -> Result<Seen> {
        let (shown, reading) = session.stage("load photos", |stage| Shown::read(self.side, photos, known, stage))?;
        let device = session.device()?;
        let seer = self.open(session, &device)?;
        let (mut seen, _) = session.stage("depth", |stage| seer.see(shown, stage))?;
        session.notes(&seen.notes);
        seen.times.insert(0, ("load photos", reading));
        Ok(seen)
    }

    /// Loads the network onto a device.
    ///
    /// # Errors
    /// As [`DepthModel::load`].
    pub fn open(self, session: &mut Session<'_>, device: &Device) -> Result<Seer> {
        let Self { checkpoint, side, cameras, arithmetic, request } = self;
        let (precision, arithmetic) = arithmetic.choose(session, device)?;
        let load = |stage: &Stage<'_>| DepthModel::load(device, checkpoint, arithmetic, |done| stage.at(done));
        let (model, loading) = session.stage("load weights", load)?;
        Ok(Seer { model, precision, side, cameras, request, loading })
    }
}

impl Shown {
    /// Reads photos as a network sees them whose longer side is `side`, and their cameras, where they have frames.
    ///
    /// # Errors
    /// Errors of photos that cannot be read, or are not those of their cameras.
    pub fn read(side: Option<u32>, photos: &[PathBuf], known: &[&Frame], stage: &Stage<'_>) -> Result<Self> {
        let read = photos::read(photos, known, stage, |_, photo| Ok(photo))?;
        let views = bounded_views(&read, side.unwrap_or(DEFAULT_BOUND))?;
        let told = (!known.is_empty()).then(|| of_views(known, &views)).transpose()?;
        Ok(Self { photos: photos.to_vec(), views, told })
    }

    /// The patches of all photos, of so many pixels a side.
    pub fn patches(&self, side: usize) -> usize {
        let of = |view: &View| (view.image.width as usize / side) * (view.image.height as usize / side);
        self.views.iter().map(of).sum()
    }
}

impl Seer {
    /// Reads photos as the network sees them: [`Shown::read`].
    ///
    /// # Errors
    /// As [`Shown::read`].
    pub fn show(&self, photos: &[PathBuf], known: &[&Frame], stage: &Stage<'_>) -> Result<Shown> {
        Shown::read(self.side, photos, known, stage)
    }

    /// Lets so large a share of the patches stand for all.
    pub fn keep(&mut self, ratio: Ratio) {
        self.request.ratio = ratio;
    }

    /// The arithmetic that it computes in.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Asks the network about photos.
    ///
    /// # Errors
    /// As [`Question::ask`], of photos that are read.
    pub fn see(&self, shown: Shown, stage: &Stage<'_>) -> Result<Seen> {
        let (Shown { photos, views, told }, begun) = (shown, Instant::now());
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        // Who sees each photo by itself has no use for cameras.
        let multi_view = self.model.architecture().multi_view();
        let request = DepthRequest { cameras: told.clone().filter(|_| multi_view), ..self.request.clone() };
        let mut depths = self.model.depths(&images, &request, |progress: Progress<'_>| {
            stage.name(progress.scope);
            stage.at(progress.fraction)
        })?;
        let seeing = begun.elapsed();
        let brought = request.cameras.as_ref().map_or(Ok(()), |cameras| depths.bring_to(cameras));
        let mut seen = Seen {
            photos,
            views,
            depths,
            cameras: told,
            lost: Vec::new(),
            notes: brought.err().iter().map(|error| format!("lengths stay in the network's unit: {error}")).collect(),
            network: self.model.architecture().name.clone(),
            precision: self.precision,
            times: vec![("load weights", self.loading), ("depth", seeing)],
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

    /// The scene of the pixels that the network is confident of, in the world of a camera with the pose `first`; of each patch at most
    /// `keep` Gaussians. Depth has its scale.
    ///
    /// # Errors
    /// [`Error::Argument`] where it is confident of none.
    pub fn scene(&self, first: &Pose, keep: Option<u32>) -> Result<Scene> {
        let here = |camera: &Camera| Camera { pose: camera.pose.relative_to(first), ..*camera };
        let cameras: Vec<Camera> = self.cameras.iter().flatten().map(here).collect();
        let images = self.images();
        let scene = self.depths.scene(&cameras, &images, keep.map(|keep| keep as usize));
        if scene.is_empty() {
            let found = format!("none of {}", counted(images.len(), "photo"));
            return Err(Error::argument("pixels of which the network is confident", found, "some"));
        }
        Ok(scene)
    }

    /// The patches whose pixels the scene has, and all of the photos.
    pub fn patches(&self) -> [usize; 2] {
        let [columns, rows] = [self.depths.width, self.depths.height].map(|side| side as usize / self.depths.patch);
        let all = self.views.len() * columns * rows;
        [self.depths.patches.as_ref().map_or(all, Vec::len), all]
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
