mod maker;

use super::{CAPTURE, Reconstruct};
use crate::{
    file_names,
    options::{Network, Quality},
    outputs::{self, FAILURES, Failure},
    panorama, photos,
    process::lock,
    session::{Session, Stage},
    stamp::{digest, hash_of_weights, stamp},
    table::{counted, time},
    views::Crop,
};
use maker::{FinishedScene, Input, Maker};
use serde_json::{Value, json};
use std::{
    collections::HashMap,
    fs::{File, TryLockError},
    path::{Path, PathBuf},
    sync::{Mutex, mpsc::sync_channel},
    time::Instant,
};
use zipsplat::{
    Error, Result,
    reconstruct::MAX_VIEWS,
    types::{
        Masks, SaveOptions, SceneFormat, World,
        poses::{Capture, CaptureView},
    },
};

/// Scenes of many captures, by one model.
///
/// A capture is finished if its scene was made of the same photos, by name, size and time, with the
/// same options.
pub struct Batch<'a> {
    command: &'a Reconstruct,
    posed: bool,
}

struct Work {
    folder: PathBuf,
    scene: PathBuf,
    record: PathBuf,
}

struct Prepared {
    input: Input,
    hash: String,
    photos: usize,
    world: Option<World>,
}

#[derive(Default)]
struct Tally {
    finished: usize,
    unchanged: usize,
    failures: Vec<Failure>,
}

impl<'a> Batch<'a> {
    pub fn of(command: &'a Reconstruct) -> Result<Self> {
        let posed = match &command.cameras {
            Some(cameras) if cameras != Path::new(CAPTURE) => {
                return Err(Error::argument("--cameras", cameras.display(), "capture, with --each"));
            }
            cameras => cameras.is_some(),
        };
        Ok(Self { command, posed })
    }

    fn crop(&self) -> Crop {
        self.command.crop.crop
    }

    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let Reconstruct { format, overwrite, .. } = self.command;
        let output = self.command.output();
        if SceneFormat::named(format).is_none() {
            return Err(Error::argument("--format", format, SceneFormat::EXTENSIONS));
        }
        outputs::check_folder(output)?;
        let works = self.works(session)?;
        overwrite.check_replaced(works.iter().map(|work| &work.record))?;
        // A .splat names no writer, its record does.
        let unknown = works.iter().filter(|work| recorded(work).is_none());
        overwrite.check_replaced(unknown.map(|work| &work.scene))?;
        overwrite.check_replaced([output.join(FAILURES)])?;
        let network = self.command.weights.open_network()?;
        let (maker, settings_key) = match &network {
            Network::Tokens(checkpoint) => Maker::of_tokens(self, session, checkpoint)?,
            Network::Pixels(checkpoint) => Maker::of_pixels(self, session, checkpoint)?,
        };

        let _lock = self.lock()?;
        let runner = Runner { batch: self, works: &works, maker, settings_key };
        let (tally, took) = session.stage("reconstruct", |stage| runner.run(stage))?;
        let Tally { finished, unchanged, failures } = tally;
        let rate = finished as f64 / took.as_secs_f64();
        let left = works.len() - finished - unchanged - failures.len();
        let json = json!({
            "output": output.to_string_lossy(), "captures": works.len(), "reconstructed": finished, "skipped": unchanged, "failed": failures.len(),
            "remaining": left, "seconds": took.as_secs_f64(), "captures_per_second": rate,
        });
        let mut text = format!("{}: {} made in {}", output.display(), counted(finished, "scene"), time(took));
        if finished > 0 {
            text += &format!(", {} each", time(took / finished as u32));
        }
        let others = [(unchanged, "there already"), (failures.len(), "failed"), (left, "left")];
        let text = outputs::and_others(text, &others);
        outputs::note_failures(session, output, &failures, "capture");
        session.report(&json, text)
    }

    /// Locks the output folder against other batches, until dropped.
    fn lock(&self) -> Result<Option<File>> {
        let output = self.command.output();
        outputs::make_folder(output)?;
        // Some file systems have no locks.
        let Ok(folder) = File::open(output) else { return Ok(None) };
        match folder.try_lock() {
            Err(TryLockError::WouldBlock) => {
                let found = format!("{}, where another batch is running", output.display());
                Err(Error::argument("--output", found, "a folder of its own for each batch"))
            }
            _ => Ok(Some(folder)),
        }
    }

    fn works(&self, session: &mut Session<'_>) -> Result<Vec<Work>> {
        let mut folders = Vec::new();
        for input in &self.command.input.photos {
            folders.extend(self.captures(session, input)?);
        }
        let mut names: HashMap<String, &Path> = HashMap::new();
        let mut works = Vec::new();
        for folder in &folders {
            // A missing listed folder fails at its turn.
            let whole = folder.canonicalize().or_else(|_| std::path::absolute(folder));
            let whole = whole.map_err(|error| Error::io(folder, error))?;
            let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if let Some(other) = names.insert(name.clone(), folder) {
                let found = format!("{name}, as {}", other.display());
                return Err(Error::argument(format!("name of {}", folder.display()), found, "one of its own"));
            }
            let file = |extension: &str| self.command.output().join(format!("{name}.{extension}"));
            works.push(Work { scene: file(&self.command.format), record: file("json"), folder: folder.clone() });
        }
        Ok(works)
    }

    fn captures(&self, session: &mut Session<'_>, input: &Path) -> Result<Vec<PathBuf>> {
        let found = input.metadata().map_err(|error| Error::io(input, error))?;
        if !found.is_dir() {
            let text = std::fs::read_to_string(input).map_err(|error| Error::io(input, error))?;
            let beside = input.parent().unwrap_or(Path::new(""));
            let lines = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
            return Ok(lines.map(|line| beside.join(line)).collect());
        }
        if self.is_capture(input)? {
            return Ok(vec![input.to_owned()]);
        }
        let (mut captures, mut others) = (Vec::new(), Vec::new());
        for folder in photos::folders_in(input)? {
            let to = if self.is_capture(&folder)? { &mut captures } else { &mut others };
            to.push(folder);
        }
        if !others.is_empty() {
            let what = format!("{} without PNG, JPEG or WebP left out", counted(others.len(), "folder"));
            session.note(format!("{what}: {}", file_names::names(&others)));
        }
        if captures.is_empty() {
            let expected = "a folder with photos, directly or in images/, or a folder of such folders";
            return Err(Error::argument("captures", input.display(), expected));
        }
        Ok(captures)
    }

    fn is_capture(&self, folder: &Path) -> Result<bool> {
        Ok(!photos_of(folder)?.is_empty() || self.posed && Capture::open(folder).is_ok())
    }

    fn settings_key(&self, weights: &str, size: &str, precision: &str) -> Result<String> {
        let of_file = hash_of_weights(Path::new(weights))?;
        let Reconstruct { quality, views, format, blocks, finding, .. } = self.command;
        let Quality { ratio, token_selection, kv_pool, .. } = quality;
        let options = [
            format!("{ratio:?} {token_selection:?} {kv_pool} {:?} {:?}", quality.kept(), self.crop()),
            format!("{size} {precision} {} {views:?} {format}", self.posed),
            format!("{:?} {:?}", blocks.options(), finding.cameras),
        ];
        Ok(format!("{} {weights} {of_file} {}", env!("CARGO_PKG_VERSION"), options.join(" ")))
    }
}

struct Runner<'a> {
    batch: &'a Batch<'a>,
    works: &'a [Work],
    maker: Maker<'a>,
    settings_key: String,
}

impl Runner<'_> {
    fn run(&self, stage: &Stage<'_>) -> Result<Tally> {
        let tally = Mutex::new(Tally::default());
        let limit = self.batch.command.limit.unwrap_or(usize::MAX);
        std::fs::remove_file(self.batch.command.output().join(FAILURES)).ok();
        let ended = std::thread::scope(|scope| {
            let (to_device, prepared) = sync_channel(1);
            let (to_disk, finished) = sync_channel::<(&Work, FinishedScene)>(1);
            scope.spawn(|| {
                let mut begun = 0;
                for work in self.works {
                    if begun == limit || stage.check().is_err() {
                        break;
                    }
                    let Some(found) = self.prepare(work, &stage.silent()).transpose() else {
                        lock(&tally).unchanged += 1;
                        continue;
                    };
                    begun += usize::from(found.is_ok());
                    if to_device.send((work, found)).is_err() {
                        break;
                    }
                }
                drop(to_device);
            });
            scope.spawn(|| {
                for (work, finished) in finished {
                    match write(work, finished) {
                        Ok(()) => lock(&tally).finished += 1,
                        Err(error) => self.failed(&tally, work, &error),
                    }
                }
            });
            let ended = prepared.into_iter().try_for_each(|(work, prepared)| {
                self.tell(stage, &lock(&tally));
                match prepared.and_then(|prepared| self.reconstruct(work, prepared, stage)) {
                    Ok(finished) => to_disk.send((work, finished)).map_err(|_| Error::Cancelled)?,
                    Err(error) if Failure::is_of_all(&error) => return Err(error),
                    Err(error) => self.failed(&tally, work, &error),
                }
                Ok(())
            });
            drop(to_disk);
            ended
        });
        ended.map(|()| tally.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()))
    }

    /// `None` if its scene is finished.
    fn prepare(&self, work: &Work, stage: &Stage<'_>) -> Result<Option<Prepared>> {
        let poses = if self.batch.posed { Some(Capture::open(&work.folder)?) } else { None };
        let photos = match &poses {
            Some(poses) => {
                let first = poses.frames.iter().filter(|frame| !frame.is_later_view());
                let photos = first.filter_map(|frame| frame.photo.clone()).collect();
                poses.per_view(photos::spread(photos, self.batch.command.views))?
            }
            None => {
                let photos = photos::spread(photos_of(&work.folder)?, self.batch.command.views);
                panorama::refuse(&photos)?;
                photos
            }
        };
        if !self.maker.takes(photos.len()) {
            let expected = format!("1 to {MAX_VIEWS}; --views N takes N of them, evenly spread");
            return Err(Error::argument(format!("photos in {}", work.folder.display()), photos.len(), expected));
        }
        let masks = self.batch.command.finding.search.masks.below(&work.folder);
        let hash = self.hash(&photos, poses.as_ref(), masks.as_ref())?;
        if recorded(work).is_some_and(|record| record["hash"] == *hash) {
            return Ok(None);
        }
        let frames: Vec<&CaptureView> =
            poses.as_ref().map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        masks.as_ref().map_or(Ok(()), |masks| masks.check(&photos))?;
        let input = self.maker.prepare(self.batch, &photos, poses.as_ref(), &frames, masks.as_ref(), stage)?;
        let world = World::of_first(&frames);
        Ok(Some(Prepared { input, hash, photos: photos.len(), world }))
    }

    fn reconstruct(&self, work: &Work, prepared: Prepared, stage: &Stage<'_>) -> Result<FinishedScene> {
        let began = Instant::now();
        let Prepared { input, hash, photos, world } = prepared;
        let FinishedScene { scene, world: of_network, record: fields } =
            self.maker.make(self.batch, input, &stage.silent())?;
        let world = world.or(of_network);
        let mut record = json!({
            "generator": outputs::MADE_BY, "capture": work.folder.to_string_lossy(), "hash": hash, "photos": photos,
            "gaussians": scene.len(), "seconds": began.elapsed().as_secs_f64(),
        });
        fields.as_object().into_iter().flatten().for_each(|(name, value)| record[name] = value.clone());
        Ok(FinishedScene { scene, world, record })
    }

    fn hash(&self, photos: &[PathBuf], poses: Option<&Capture>, masks: Option<&Masks>) -> Result<String> {
        let mut parts = vec![self.settings_key.clone()];
        for photo in photos {
            parts.push(stamp(photo)?);
            if let Some(masks) = masks {
                parts.push(format!("{} {}", masks.inverted, stamp(&masks.file(photo)?)?));
            }
        }
        if let Some(poses) = poses {
            parts.push(format!("{:?}", poses.frames));
            parts.push(poses.points.as_deref().map(stamp).transpose()?.unwrap_or_default());
        }
        Ok(digest(&parts))
    }

    fn failed(&self, tally: &Mutex<Tally>, work: &Work, error: &Error) {
        let failures = &mut lock(tally).failures;
        failures.push(Failure::new(work.folder.display(), error));
        // Without the file, the count still reports the failure.
        outputs::save_csv(&self.batch.command.output().join(FAILURES), failures).ok();
    }

    fn tell(&self, stage: &Stage<'_>, tally: &Tally) {
        let done = tally.finished + tally.failures.len();
        let all = (self.works.len() - tally.unchanged).min(self.batch.command.limit.unwrap_or(usize::MAX)).max(1);
        let _ = stage.at(done as f64 / all as f64);
        stage.name(&format!("{done} of {all}"));
    }
}

/// The record marks the scene complete.
fn write(work: &Work, finished: FinishedScene) -> Result<()> {
    std::fs::remove_file(&work.record).ok();
    outputs::save_scene(&work.scene, &finished.scene, &SaveOptions::default(), finished.world.as_ref())?;
    let mut record = finished.record;
    record["bytes"] = json!(outputs::size_of(&work.scene)?);
    outputs::save_json(&work.record, &record)
}

/// Returns the record of a scene that still has the recorded size.
fn recorded(work: &Work) -> Option<Value> {
    let record: Value = serde_json::from_slice(&std::fs::read(&work.record).ok()?).ok()?;
    let bytes = work.scene.metadata().ok()?.len();
    (record["bytes"].as_u64() == Some(bytes)).then_some(record)
}

/// The folder's, or else those of its images/.
fn photos_of(folder: &Path) -> Result<Vec<PathBuf>> {
    let photos = photos::directly_in(folder)?;
    let below = folder.join("images");
    if photos.is_empty() && below.is_dir() { photos::directly_in(&below) } else { Ok(photos) }
}
