//! Cameras of photos that have none, found by COLMAP.

use super::colmap::{Colmap, Step, Told};
use crate::{
    outputs::LOG_START,
    photos::names,
    process,
    session::{Session, Stage},
    table::counted,
};
use clap::{Args, ValueEnum};
use std::{
    collections::HashMap,
    fs::File,
    io::{BufReader, Write},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};
use tempfile::{NamedTempFile, TempDir};
use zipsplat::{
    Error, Result,
    types::{
        Image, open_file,
        poses::{Frame, Poses, read_cloud, read_poses},
    },
};

/// The word that stands for a file of cameras where they are to be found.
const FIND: &str = "find";
/// Most photos of which all pairs are matched where nobody says: their number goes with the square.
const ALL_PAIRS: usize = 100;
/// Features of a photo below which there is little to recognise.
const FEW: usize = 300;
/// Share of a step before which nobody can tell how long it takes.
const TELLING: f64 = 0.04;

/// How cameras are found.
#[derive(Args, Clone, Default)]
pub struct Finding {
    /// COLMAP's program, 3.x or 4.x, where cameras are to be found [default: colmap, else the pycolmap of python3]
    #[arg(long, value_name = "PROGRAM")]
    pub colmap: Option<PathBuf>,
    /// Python with pycolmap, in place of COLMAP's program
    #[arg(long, value_name = "PROGRAM", conflicts_with = "colmap")]
    pub python: Option<PathBuf>,
    /// Photos that are searched for the same points [default: all pairs of up to 100 photos, else near]
    #[arg(long, value_enum, value_name = "WHICH")]
    pub pairs: Option<Pairs>,
    /// Longer side of the photos in which points are looked for; larger photos are scaled down to it
    #[arg(long, value_name = "PIXELS", default_value = "1600", value_parser = clap::value_parser!(u32).range(64..=32_768))]
    pub find_size: u32,
}

/// Pairs of photos that are matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Pairs {
    /// Every one with every other
    All,
    /// Photos near each other in the order of their names, as frames of a video are
    Near,
}

/// Cameras, and what is known of how they were found.
pub struct Known {
    pub poses: Poses,
    /// The findings, where cameras were found and not read.
    pub found: Option<Found>,
}

/// How cameras were found. COLMAP's files, the points among them, last as long as this.
pub struct Found {
    /// Photos that have no camera.
    pub lost: Vec<PathBuf>,
    /// Photos with a camera.
    pub count: usize,
    /// The numbers of photos, of those that have no camera, in groups that COLMAP could not join with the others.
    pub groups: Vec<usize>,
    pub points: usize,
    /// The program that found them.
    pub program: String,
    pub times: Vec<(&'static str, Duration)>,
    pub(super) log: Log,
    _work: TempDir,
}

/// All that COLMAP said.
pub(super) struct Log(NamedTempFile);

/// The photos in a folder of their own, under names that COLMAP's files have room for.
struct Work {
    folder: TempDir,
    /// Each photo and the name of its copy.
    photos: Vec<(PathBuf, String)>,
}

impl Known {
    /// The cameras of a file, or where `poses` is `find` those that COLMAP finds for `photos`, which is noted.
    ///
    /// # Errors
    /// As [`read_poses`] and [`Found::of`].
    pub fn of(session: &mut Session<'_>, poses: &Path, photos: &[PathBuf], finding: &Finding) -> Result<Self> {
        if !Self::to_find(poses) {
            return Ok(Self { poses: read_poses(poses)?, found: None });
        }
        let (poses, found) = Found::of(session, photos, finding)?;
        session.note(format!("cameras found: {}", found.told()));
        Ok(Self { poses, found: Some(found) })
    }

    /// True where cameras are to be found; a file of that name is `./find`.
    pub fn to_find(poses: &Path) -> bool {
        poses == Path::new(FIND)
    }
}

impl Found {
    /// The cameras of photos, in a world and unit of COLMAP's choice. Frames have the names of the photos' files, or of several that
    /// share one their paths.
    ///
    /// # Errors
    /// [`Error::Argument`] where COLMAP is missing or finds no cameras, with the likely reason; [`Error::Io`] where it fails, with
    /// the path of its log; of photos as [`Image::size`]; [`Error::Cancelled`].
    pub fn of(session: &mut Session<'_>, photos: &[PathBuf], finding: &Finding) -> Result<(Poses, Self)> {
        let colmap = Colmap::of(finding)?;
        if photos.len() < 2 {
            return Err(Error::argument("photos to find cameras of", photos.len(), "two or more of one place"));
        }
        let pairs = finding.pairs.unwrap_or(if photos.len() > ALL_PAIRS { Pairs::Near } else { Pairs::All });
        let (work, _) = session.stage("prepare photos", |stage| Work::new(photos, stage))?;
        let (mut log, mut told, mut times) = (Log::new()?, Told::default(), Vec::new());
        for step in Step::ALL {
            let mut command = colmap.command(step, work.folder.path(), pairs, finding.find_size)?;
            let (status, took) = session.stage(step.name(), |stage| {
                let started = Instant::now();
                process::run(&mut command, stage, |line| {
                    log.write(line)?;
                    told.hear(line, photos.len()).map_or(Ok(()), |far| told_far(stage, step, far, started))
                })
            })?;
            times.push((step.name(), took));
            if told.no_room {
                let why = "COLMAP found no room left for its files; TMPDIR says where they go";
                return Err(process::failure(&std::env::temp_dir(), why, status));
            }
            // So the mapper ends where there is nothing to find.
            let finds_nothing = step == Step::Cameras && told.no_start && status.code() == Some(1);
            if !status.success() && !finds_nothing {
                let place = log.keep()?;
                let said = match told.last_words() {
                    words if words.is_empty() => String::new(),
                    words => format!("; its last words: {words}"),
                };
                let why = format!("could not {}: {status}{said}; all of them: {}", step.name(), place.display());
                return Err(process::failure(colmap.program(), &why, status));
            }
        }
        let mut models = work.models()?;
        // Of equal ones the first.
        models.sort_by_key(|model| std::cmp::Reverse(model.frames.len()));
        let mut models = models.into_iter();
        let Some(model) = models.next() else { return Err(nothing(photos.len(), &told)) };
        let alone = |frame: &&Frame| !model.frames.iter().any(|other| other.name == frame.name);
        let groups = models.map(|other| other.frames.iter().filter(alone).count()).filter(|count| *count > 0).collect();
        let (poses, lost) = work.named(model)?;
        let points = poses.points.as_ref().map(read_cloud).transpose()?.map_or(0, |cloud| cloud.positions.len());
        let program = colmap.to_string();
        let count = poses.frames.len();
        Ok((poses, Self { lost, count, groups, points, program, times, log, _work: work.folder }))
    }

    /// The outcome in words.
    pub fn told(&self) -> String {
        let mut text = format!("{} of {}", self.count, counted(self.count + self.lost.len(), "photo"));
        text += &format!(", {}, by {}", counted(self.points, "point"), self.program);
        if !self.lost.is_empty() {
            text += &format!("; without a camera: {}", names(&self.lost));
        }
        if !self.groups.is_empty() {
            let groups: Vec<String> = self.groups.iter().map(ToString::to_string).collect();
            text += &format!("; of them groups of {} see something of their own", groups.join(", "));
        }
        text
    }
}

/// Shows how far a step is, and how long it may still take.
fn told_far(stage: &Stage<'_>, step: Step, far: f64, started: Instant) -> Result<()> {
    if far > TELLING {
        let left = started.elapsed().as_secs_f64() * (1.0 - far) / far;
        stage.name(&format!("{}, {left:.0} s left", step.name()));
    }
    stage.reach(far)
}

/// Why there may be no camera at all.
fn nothing(photos: usize, told: &Told) -> Error {
    let mut features = told.features.clone();
    features.sort_unstable();
    let median = features.get(features.len() / 2).copied().unwrap_or(0);
    let (pairs, all) = (told.pairs.unwrap_or(0), photos * (photos - 1) / 2);
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

impl Work {
    /// Photos of one size and lens share a folder, and so a camera's intrinsics. JPEG and PNG are linked, so that COLMAP reads
    /// their EXIF; others, which it may not read, become PNG.
    fn new(photos: &[PathBuf], stage: &Stage<'_>) -> Result<Self> {
        let folder = tempfile::Builder::new().prefix("zipsplat-").tempdir();
        let folder = folder.map_err(|source| Error::io(std::env::temp_dir(), source))?;
        let mut cameras = HashMap::new();
        make_folder(&folder.path().join("sparse"))?;
        let mut work = Self { folder, photos: Vec::new() };
        stage.each(&photos.iter().enumerate().collect::<Vec<_>>(), |(number, photo)| {
            let count = cameras.len();
            let camera = *cameras.entry((Image::size_as_stored(photo)?, optics(photo))).or_insert(count);
            let kind = kind(photo)?;
            let name = format!("{camera}/{number:06}.{}", kind.unwrap_or("png"));
            let path = work.folder.path().join("images").join(&name);
            make_folder(path.parent().unwrap_or(&path))?;
            match kind {
                Some(_) => link(photo, &path)?,
                None => Image::open_as_stored(photo)?.save_png(&path)?,
            }
            work.photos.push(((*photo).clone(), name));
            Ok(())
        })?;
        Ok(work)
    }

    /// The groups of photos that COLMAP could join.
    fn models(&self) -> Result<Vec<Poses>> {
        let sparse = self.folder.path().join("sparse");
        let failed = |source| Error::io(&sparse, source);
        let mut folders = Vec::new();
        for entry in sparse.read_dir().map_err(failed)? {
            folders.push(entry.map_err(failed)?.path());
        }
        folders.sort();
        let models =
            folders.iter().filter(|folder| folder.join("images.bin").exists() || folder.join("images.txt").exists());
        models.map(read_poses).filter(|model| !matches!(model, Ok(poses) if poses.frames.is_empty())).collect()
    }

    /// The model with the photos' own paths, in their order, and the photos that it lacks.
    fn named(&self, model: Poses) -> Result<(Poses, Vec<PathBuf>)> {
        let mut frames: HashMap<String, Frame> =
            model.frames.into_iter().map(|frame| (frame.name.clone(), frame)).collect();
        let mut poses = Poses { points: model.points, notes: model.notes, ..Poses::default() };
        let mut lost = Vec::new();
        for (photo, name) in &self.photos {
            let Some(frame) = frames.remove(name) else {
                lost.push(photo.clone());
                continue;
            };
            let of_photo = Image::size_as_stored(photo)?;
            let of_camera = (frame.camera.intrinsics.width, frame.camera.intrinsics.height);
            if of_camera != of_photo {
                let found = format!("{}x{}", of_camera.0, of_camera.1);
                let expected = format!("{}x{}, as the photo is stored", of_photo.0, of_photo.1);
                return Err(Error::argument(
                    format!("camera that COLMAP found for {}", photo.display()),
                    found,
                    expected,
                ));
            }
            poses.frames.push(Frame {
                name: photo.to_string_lossy().into_owned(),
                photo: Some(photo.clone()),
                ..frame
            });
        }
        Ok((poses, lost))
    }
}

fn make_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(|source| Error::io(path, source))
}

/// The extension of a kind of photo that every COLMAP reads, by the file's first bytes.
fn kind(photo: &Path) -> Result<Option<&'static str>> {
    let mut start = [0; 4];
    let read = std::io::Read::read_exact(&mut open_file(photo)?, &mut start);
    read.map_err(|source| Error::io(photo, source))?;
    Ok(match start {
        [0xff, 0xd8, ..] => Some("jpg"),
        [0x89, b'P', b'N', b'G'] => Some("png"),
        _ => None,
    })
}

/// Puts a photo at another place without copying it, where the system can.
fn link(photo: &Path, to: &Path) -> Result<()> {
    let failed = |source| Error::io(photo, source);
    let photo = photo.canonicalize().map_err(failed)?;
    #[cfg(unix)]
    let linked = std::os::unix::fs::symlink(&photo, to);
    #[cfg(not(unix))]
    let linked = std::fs::hard_link(&photo, to).or_else(|_| std::fs::copy(&photo, to).map(drop));
    linked.map_err(failed)
}

/// Camera and lens as a photo's EXIF has them: photos of a phone may be of several lenses.
fn optics(photo: &Path) -> Option<String> {
    let read = exif::Reader::new().read_from_container(&mut BufReader::new(File::open(photo).ok()?)).ok()?;
    let tags = [exif::Tag::Model, exif::Tag::FocalLength, exif::Tag::FocalLengthIn35mmFilm];
    let value = |tag| read.get_field(tag, exif::In::PRIMARY).map(|field| field.display_value().to_string());
    Some(tags.map(|tag| value(tag).unwrap_or_default()).join(" "))
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

    pub(super) fn path(&self) -> &Path {
        self.0.path()
    }

    /// Leaves it for who looks for a reason.
    fn keep(self) -> Result<PathBuf> {
        let path = self.0.path().to_owned();
        self.0.keep().map(|(_, path)| path).map_err(|error| Error::io(path, error.error))
    }
}
