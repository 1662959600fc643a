use super::{
    colmap::{Colmap, Mapping, Matching, Searching, Step},
    colmap_output::ColmapOutput,
    work::Work,
};
use crate::{
    depth::{CamerasFrom, PredictedViews},
    file_names::{names, text},
    outputs::{LOG_START, make_folder},
    process,
    scratch::Scratch,
    session::Session,
    stamp::entries,
    table::counted,
};
use clap::{Args, ValueEnum};
use std::{
    cmp::Reverse,
    io::Write,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    process::ExitStatus,
    time::Duration,
};
use tempfile::NamedTempFile;
use zipsplat::{
    Error, Result,
    stages::Family,
    types::{
        Camera, Masks, median,
        poses::{Capture, CaptureView, read_cloud},
    },
};

/// Estimates cameras, unless a folder of this name holds a model.
pub const COLMAP: &str = "colmap";
const FIND: &str = "find";
const DA3: &str = "da3";
const VGGT: &str = "vggt";
const SIDE: u32 = 1600;
/// Limit for exhaustive matching, quadratic in photos.
const ALL_PAIRS: usize = 100;
/// Bundle adjustment is quadratic in photos of one place: longer videos' cameras follow from the
/// points of keyframes.
const MAX_KEYFRAMES: usize = 150;
/// Most photos for a retry after a single unregistered one.
const FEW_PHOTOS: usize = 12;
/// Registered fraction without retry, for more photos.
const ENOUGH: f64 = 0.8;
/// Features below which a photo has too little texture.
const FEW: usize = 300;
/// Focal lengths over the longer side: fields of view of 110 to 11 degrees.
const LIKELY: RangeInclusive<f64> = 0.35..=5.0;

#[derive(Args, Clone, Default)]
pub struct Finding {
    #[command(flatten)]
    pub search: Searching,
    #[command(flatten)]
    pub cameras: CamerasFrom,
    /// Weights for --cameras da3 and vggt, as for `depth`
    #[arg(long, value_name = "NAME|PATH|seeded:NAME")]
    pub depth_weights: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Finder {
    /// COLMAP, from matched features
    Colmap,
    /// Depth Anything 3, in one pass
    Da3,
    /// VGGT, in one pass
    Vggt,
}

pub struct KnownCameras {
    pub poses: Capture,
    pub found: Option<EstimatedCameras>,
}

pub struct EstimatedCameras {
    pub predicted: Option<Box<PredictedViews>>,
    pub lost: Vec<PathBuf>,
    pub count: usize,
    pub groups: Vec<usize>,
    pub points: usize,
    /// Median focal length over the photo's longer side.
    pub focal: f64,
    pub mappings: usize,
    pub program: String,
    pub times: Vec<(&'static str, Duration)>,
    pub(super) log: Option<Log>,
    pub(super) _work: Scratch,
}

pub(super) struct Log(pub NamedTempFile);

struct Search<'a> {
    colmap: &'a Colmap,
    work: &'a Work,
    pairs: Matching,
    side: u32,
    keyframes: usize,
    log: Log,
    output: ColmapOutput,
    times: Vec<(&'static str, Duration)>,
}

impl Finding {
    pub fn masks(&self) -> Option<Masks> {
        self.search.masks.given()
    }
}

impl Finder {
    /// Files of those names are `./da3` and `./vggt`.
    pub fn named(poses: &Path) -> Option<Self> {
        let finders = [(FIND, Self::Colmap), (COLMAP, Self::Colmap), (DA3, Self::Da3), (VGGT, Self::Vggt)];
        let mut finders = finders.into_iter().filter(|(word, _)| *word != COLMAP || !poses.exists());
        finders.find(|(word, _)| poses == Path::new(word)).map(|(_, finder)| finder)
    }

    pub fn family(self) -> Option<Family> {
        match self {
            Self::Colmap => None,
            Self::Da3 => Some(Family::Da3),
            Self::Vggt => Some(Family::Vggt),
        }
    }

    /// Frames are named after files, or after paths if files share a name.
    pub fn find(
        self,
        session: &mut Session<'_>,
        photos: &[PathBuf],
        finding: &Finding,
    ) -> Result<(Capture, EstimatedCameras)> {
        photos.iter().try_for_each(|photo| text(Path::new(photo.file_name().unwrap_or_default())).map(drop))?;
        match self.family() {
            None => EstimatedCameras::by_colmap(session, photos, &finding.search),
            Some(family) => EstimatedCameras::by_network(session, photos, finding, family),
        }
    }
}

impl KnownCameras {
    /// Reads a camera file, or estimates cameras for a [`Finder`]'s word.
    pub fn of(session: &mut Session<'_>, poses: &Path, photos: &[PathBuf], finding: &Finding) -> Result<Self> {
        let Some(finder) = Finder::named(poses) else { return Ok(Self { poses: Capture::open(poses)?, found: None }) };
        let (poses, found) = finder.find(session, photos, finding)?;
        session.note(format!("cameras found: {}", found.summary()));
        Ok(Self { poses, found: Some(found) })
    }

    pub fn to_find(poses: &Path) -> bool {
        Finder::named(poses).is_some()
    }
}

impl EstimatedCameras {
    /// In a world and unit of COLMAP's choice.
    fn by_colmap(session: &mut Session<'_>, photos: &[PathBuf], searching: &Searching) -> Result<(Capture, Self)> {
        let (colmap, _) = session.stage("look for COLMAP", |stage| Colmap::of(searching, stage))?;
        if photos.len() < 2 {
            return Err(Error::argument("photos to find cameras of", photos.len(), "two or more of one place"));
        }
        let masks = searching.masks.given();
        let (work, _) = session.stage("prepare photos", |stage| Work::new(photos, masks.as_ref(), stage))?;
        let mut search = Search::new(searching, &colmap, &work)?;
        search.prepare(session, Step::Features)?;
        search.prepare(session, Step::Matches)?;
        let (models, mappings) = search.map(session)?;
        let Search { output, log, times, .. } = search;
        let mut models = models.into_iter();
        let Some(model) = models.next() else { return Err(nothing(photos.len(), &output)) };
        let alone = |frame: &&CaptureView| !model.frames.iter().any(|other| other.name == frame.name);
        let groups = models.map(|other| other.frames.iter().filter(alone).count()).filter(|count| *count > 0).collect();
        let first = model.frames.first().map_or(String::new(), |frame| frame.name.clone());
        let (poses, lost) = work.named(model)?;
        if poses.frames.is_empty() {
            let found = format!("{first}, which is none of the photos");
            return Err(Error::argument(format!("photo in the model of {colmap}"), found, "a name that it was given"));
        }
        let points = points(&poses)?;
        let (program, count, focal) = (colmap.to_string(), poses.frames.len(), focal(&poses.frames));
        let (log, _work) = (Some(log), work.folder);
        Ok((poses, Self { predicted: None, lost, count, groups, points, focal, mappings, program, times, log, _work }))
    }

    pub fn summary(&self) -> String {
        let mut text = format!("{} of {}", self.count, counted(self.count + self.lost.len(), "photo"));
        text += &format!(", {}, by {}", counted(self.points, "point"), self.program);
        if self.mappings > 1 {
            text += &format!("; the best of {} attempts of COLMAP", self.mappings);
        }
        if !self.lost.is_empty() {
            text += &format!("; without a camera: {}", names(&self.lost));
        }
        if !self.groups.is_empty() {
            let groups: Vec<String> = self.groups.iter().map(ToString::to_string).collect();
            text += &format!("; of them groups of {} see something of their own", groups.join(", "));
        }
        if !LIKELY.contains(&self.focal) {
            text += &format!(
                "; their focal length, {:.2} of a photo's longer side, is unlikely, and so these cameras are",
                self.focal
            );
            text += " probably wrong: photos from more directions tell it";
        }
        text
    }
}

impl<'a> Search<'a> {
    fn new(searching: &Searching, colmap: &'a Colmap, work: &'a Work) -> Result<Self> {
        let count = work.photos.len();
        let default = if count > ALL_PAIRS { Matching::Sequential } else { Matching::Exhaustive };
        let pairs = searching.matching.unwrap_or(default);
        let side = searching.matching_size.unwrap_or(SIDE);
        let most = if colmap.python { count } else { MAX_KEYFRAMES };
        let keyframes = if pairs == Matching::Sequential { work.choose_keyframes(most)? } else { count };
        let (log, output) = (Log::new()?, ColmapOutput::default());
        Ok(Self { colmap, work, pairs, side, keyframes, log, output, times: Vec::new() })
    }

    fn run(&mut self, session: &Session<'_>, step: Step, models: &Path) -> Result<Option<ExitStatus>> {
        let folders = [self.work.folder.path(), models];
        let photos = match step {
            Step::Cameras(Mapping { keyframes: true, .. }) => self.keyframes,
            _ => self.work.photos.len(),
        };
        let (log, output) = (&mut self.log, &mut self.output);
        let (status, took) = session.stage(step.name(), |stage| {
            let mut command = self.colmap.command(step, folders, self.pairs, self.side, stage)?;
            process::run(&mut command, stage, |line| {
                log.write(line)?;
                output.hear(line, photos).map_or(Ok(()), |far| stage.reach(far))
            })
        })?;
        match self.times.iter_mut().find(|(name, _)| *name == step.name()) {
            Some((_, all)) => *all += took,
            None => self.times.push((step.name(), took)),
        }
        if output.no_room {
            let why = "COLMAP found no room left for its files; TMPDIR says where they go";
            return Err(process::failure(&std::env::temp_dir(), why, status));
        }
        let found_nothing = output.found_nothing(step, status);
        Ok(Some(status).filter(|status| !status.success() && !found_nothing))
    }

    /// Fails if COLMAP does.
    fn prepare(&mut self, session: &Session<'_>, step: Step) -> Result<()> {
        let status = self.run(session, step, self.work.folder.path())?;
        status.map_or(Ok(()), |status| Err(self.failure(step, status)))
    }

    /// Returns the groups, largest first, and the number of attempts. Retries with all photos if
    /// few are joined, and with a fixed lens for implausible focal lengths.
    fn map(&mut self, session: &Session<'_>) -> Result<(Vec<Capture>, usize)> {
        let photos = self.work.photos.len();
        let enough = if photos <= FEW_PHOTOS { photos } else { (ENOUGH * photos as f64) as usize };
        let (mut best, mut best_rank, mut attempts) = (Vec::new(), (0, false, 0), 0);
        let mut keyframe_pairs = self.keyframes < photos;
        let mut mappings = Mapping::ALL.iter();
        while let Some(&(mut mapping)) = mappings.next() {
            mapping.keyframes &= self.keyframes < photos;
            if !mapping.keyframes && std::mem::take(&mut keyframe_pairs) {
                self.work.list_pairs(1)?;
                self.prepare(session, Step::Matches)?;
            }
            let models = self.work.folder.path().join(format!("sparse{attempts}"));
            make_folder(&models)?;
            attempts += 1;
            match self.run(session, Step::Cameras(mapping), &models)? {
                Some(status) if best.is_empty() => return Err(self.failure(Step::Cameras(mapping), status)),
                // The log has the reason.
                Some(_) => break,
                None => {}
            }
            if mapping.keyframes {
                for model in model_folders(&models)? {
                    // A failure leaves the keyframes.
                    self.run(session, Step::Registration, &model)?;
                }
            }
            let mut models = models_of(&models)?;
            models.sort_by_key(|model| Reverse(model.frames.len()));
            let rank = models.first().map_or(Ok((0, true, 0)), rank)?;
            if rank > best_rank {
                (best, best_rank) = (models, rank);
            }
            let (joined, likely, _) = best_rank;
            if mapping.refines_lens && !likely {
                mappings = Mapping::FIXED_LENS.iter();
            } else if mapping.refines_lens && joined >= enough {
                break;
            }
        }
        Ok((best, attempts))
    }

    /// Keeps the log.
    fn failure(&mut self, step: Step, status: ExitStatus) -> Error {
        let last_words = match self.output.last_words() {
            words if words.is_empty() => String::new(),
            words => format!("; its last words: {words}"),
        };
        self.log.0.disable_cleanup(true);
        let log = self.log.0.path().display();
        let why = format!("could not {}: {status}{last_words}; all of them: {log}", step.name());
        process::failure(&self.colmap.program, &why, status)
    }
}

/// Number of photos, whether the focal length is likely, number of points: a wrong structure loses
/// points.
fn rank(model: &Capture) -> Result<(usize, bool, usize)> {
    Ok((model.frames.len(), LIKELY.contains(&focal(&model.frames)), points(model)?))
}

fn points(model: &Capture) -> Result<usize> {
    Ok(model.points.as_ref().map(read_cloud).transpose()?.map_or(0, |cloud| cloud.positions.len()))
}

pub(super) fn focal(frames: &[CaptureView]) -> f64 {
    let focal = |CaptureView { camera: Camera { intrinsics, .. }, .. }: &CaptureView| {
        intrinsics.fx / f64::from(intrinsics.width.max(intrinsics.height))
    };
    median(frames.iter().map(focal)).unwrap_or(f64::NAN)
}

fn nothing(photos: usize, output: &ColmapOutput) -> Error {
    let mut features = output.features.clone();
    features.sort_unstable();
    let median = features.get(features.len() / 2).copied().unwrap_or(0);
    let (pairs, all) = (output.pairs.unwrap_or(0), photos * (photos - 1) / 2);
    let (why, expected) = match () {
        () if median < FEW => (
            format!("their details are few, {median} in the median photo"),
            "photos that are sharp and bright, of things with texture",
        ),
        () if pairs == 0 => (
            "no two of them show the same things".into(),
            "photos of one place, each of which shows much of what another shows",
        ),
        () => (
            format!("{pairs} of {all} pairs show the same things, but none from places far enough apart"),
            "photos from different places: a step to the side between two, not only a turn",
        ),
    };
    Error::argument(format!("cameras of {photos} photos"), format!("none: {why}"), expected)
}

fn model_folders(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut folders = entries(folder)?;
    folders.retain(|folder| folder.join("images.bin").exists() || folder.join("images.txt").exists());
    Ok(folders)
}

fn models_of(folder: &Path) -> Result<Vec<Capture>> {
    // COLMAP may write small groups with impossible lenses; the others stay usable.
    let (found, mut failed): (Vec<_>, Vec<_>) =
        model_folders(folder)?.iter().map(Capture::open).partition(Result::is_ok);
    match failed.pop() {
        Some(error) if found.is_empty() => error.map(|_| Vec::new()),
        _ => Ok(found.into_iter().flatten().filter(|poses| !poses.frames.is_empty()).collect()),
    }
}

impl Log {
    fn new() -> Result<Self> {
        let file = tempfile::Builder::new().prefix("zipsplat-colmap-").suffix(".log").tempfile();
        let mut log = Self(file.map_err(|source| Error::io(std::env::temp_dir(), source))?);
        log.write(LOG_START)?;
        Ok(log)
    }

    fn write(&mut self, line: &str) -> Result<()> {
        writeln!(self.0.as_file_mut(), "{line}").map_err(|source| Error::io(self.0.path(), source))
    }
}
