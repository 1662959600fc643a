use crate::{
    cameras::KnownCameras,
    file_names::{named, names, unique_stems},
    heic::{is_heic, to_jpeg},
    masks::MaskArgs,
    options::{Size, refuse},
    outputs::Overwrite,
    panorama::{self, CameraModel},
    session::{Session, Stage},
    stamp::entries,
    table::counted,
    video::{FRAMES, FrameFolder, is_video, sharpest_frames},
};
use clap::Args;
use rayon::prelude::*;
use std::{
    borrow::Cow,
    cmp::Ordering,
    collections::HashSet,
    ffi::OsString,
    path::{Path, PathBuf},
    sync::atomic::{self, AtomicUsize},
};
use zipsplat::{
    Error, Result,
    refine::Photos,
    types::{Image, Masks, PHOTO_EXTENSIONS, is_photo, natural_order, poses::CaptureView, preprocess::crop_to_aspect},
};

/// Share of the area that needs a warning.
const CROPPED: f64 = 0.1;

#[derive(Args)]
pub struct PhotoArgs {
    /// Photos (PNG, JPEG, WebP; HEIC with ffmpeg), folders of photos in natural order, or videos,
    /// which contribute their sharpest frames
    #[arg(required = true)]
    pub photos: Vec<PathBuf>,
    #[command(flatten)]
    reading: Reading,
}

impl PhotoArgs {
    pub fn list(
        &self,
        session: &mut Session<'_>,
        frames: Option<u32>,
        unposed: Option<&MaskArgs>,
        named_in: Option<(&Path, Overwrite)>,
    ) -> Result<(Vec<PathBuf>, Option<FrameFolder>)> {
        self.reading.list(session, &self.photos, frames, unposed, named_in)
    }
}

#[derive(Args)]
pub struct Reading {
    /// Include photos of nested folders
    #[arg(long)]
    recursive: bool,
    /// Program that decodes videos and HEIC
    #[arg(long, value_name = "PROGRAM", default_value = "ffmpeg")]
    pub ffmpeg: PathBuf,
    /// Camera model of photos and videos without a camera file. Equirectangular 360-degree photos
    /// are cut into 8 overlapping pinhole photos, whose cameras are found one by one [default:
    /// equirectangular for photos of 2:1 whose GPano metadata says so, else pinhole]
    #[arg(long, value_enum, value_name = "MODEL")]
    pub camera_model: Option<CameraModel>,
}

impl Reading {
    /// Also converts videos and HEIC: `frames` per video, or a default. Takes `frames` of `unposed`
    /// photos and cuts 360-degree ones, with masks. The folder of converted photos lies beside any
    /// camera file.
    pub fn list(
        &self,
        session: &mut Session<'_>,
        paths: &[PathBuf],
        frames: Option<u32>,
        unposed: Option<&MaskArgs>,
        named_in: Option<(&Path, Overwrite)>,
    ) -> Result<(Vec<PathBuf>, Option<FrameFolder>)> {
        let listed = list(session, paths, self.recursive)?;
        let heic: Vec<&PathBuf> = listed.iter().filter(|path| is_heic(path)).collect();
        let beside = |(file, overwrite): (&Path, Overwrite)| FrameFolder::beside(file, overwrite.is_given());
        let make = || named_in.map_or_else(FrameFolder::temporary, beside);
        let videos: Vec<&PathBuf> = listed.iter().filter(|path| is_video(path)).collect();
        let mut folder = (!heic.is_empty() || !videos.is_empty()).then(make).transpose()?;
        let mut made = match (&heic[..], &folder) {
            ([_, ..], Some(folder)) => to_jpeg(session, &self.ffmpeg, &heic, folder.path())?,
            _ => Vec::new(),
        }
        .into_iter();
        let mut stems = unique_stems(&videos).into_iter();
        let mut photos = Vec::new();
        for path in &listed {
            match &folder {
                Some(folder) if is_video(path) => {
                    let count = frames.map_or(FRAMES, |frames| frames as usize);
                    let start = folder.path().join(stems.next().unwrap_or_default());
                    photos.extend(sharpest_frames(session, &self.ffmpeg, path, count, &start)?);
                }
                Some(_) if is_heic(path) => photos.extend(made.next()),
                _ => photos.push(path.clone()),
            }
        }
        let Some(masks) = unposed else {
            refuse("--camera-model", self.camera_model.is_some(), "cameras of a file", "photos without a camera file")?;
            return Ok((photos, folder));
        };
        let photos = spread(photos, frames);
        let is_panorama = panorama::find(session, &photos, self.camera_model)?;
        if !is_panorama.contains(&true) {
            return Ok((photos, folder));
        }
        let place = folder.take().map_or_else(make, Ok)?;
        let photos = panorama::cut(session, &photos, &is_panorama, masks, place.path())?;
        Ok((photos, Some(place)))
    }
}

/// Photos, and their cameras if known.
pub struct Photographed {
    pub photos: Vec<PathBuf>,
    pub known: Option<KnownCameras>,
    /// Of converted photos.
    pub folder: Option<FrameFolder>,
}

/// Photos of folders are in natural order. Notes skipped files, except hidden ones.
pub fn list(session: &mut Session<'_>, paths: &[PathBuf], recursive: bool) -> Result<Vec<PathBuf>> {
    let listed: Result<Vec<_>> = paths.iter().map(|path| list_path(session, path, recursive)).collect();
    Ok(listed?.concat())
}

fn list_path(session: &mut Session<'_>, path: &Path, recursive: bool) -> Result<Vec<PathBuf>> {
    if !path.metadata().map_err(|error| Error::io(path, error))?.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    if !recursive {
        return list_folder(session, path);
    }
    let mut photos = Vec::new();
    list_below(path, &mut photos)?;
    if photos.is_empty() {
        let expected = format!("files that end in {}", PHOTO_EXTENSIONS.join(", "));
        return Err(Error::argument(format!("photos in {} and below", path.display()), "none", expected));
    }
    Ok(photos)
}

/// Skips links to folders against cycles.
fn list_below(folder: &Path, photos: &mut Vec<PathBuf>) -> Result<()> {
    let entries = sorted(folder, |_| true)?;
    let files = entries.iter().filter(|path| path.is_file()).cloned().collect();
    photos.extend(photos_among(files).0);
    entries.iter().filter(|path| path.is_dir() && !path.is_symlink()).try_for_each(|path| list_below(path, photos))
}

fn by_name(a: &PathBuf, b: &PathBuf) -> Ordering {
    natural_order(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b))
}

fn list_folder(session: &mut Session<'_>, folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = visible(folder)?;
    let (folders, mut files): (Vec<PathBuf>, Vec<PathBuf>) =
        entries.into_iter().filter(|path| path.is_dir() || path.is_file()).partition(|path| path.is_dir());
    files.sort_by(by_name);
    let (photos, others) = photos_among(files);
    let below = folders_of_photos(folders);
    if photos.is_empty() {
        let what = format!("photos in {}", folder.display());
        if !below.is_empty() {
            return Err(Error::argument(what, "none", format!("files there, or the folder that has them: {below}")));
        }
        // The first file's format may explain the missing photos.
        others.first().map_or(Ok((0, 0)), Image::size)?;
        let expected = format!("files that end in {}", PHOTO_EXTENSIONS.join(", "));
        return Err(Error::argument(what, "none", expected));
    }
    if !others.is_empty() {
        let (originals, unknown): (Vec<PathBuf>, Vec<PathBuf>) = others.into_iter().partition(|path| is_heic(path));
        for (files, why) in
            [(originals, "HEIC beside a photo of the same name"), (unknown, "not PNG, JPEG, WebP or HEIC")]
        {
            if !files.is_empty() {
                session.note(format!("{} left out, {why}: {}", counted(files.len(), "file"), names(&files)));
            }
        }
    }
    if !below.is_empty() {
        session.note(format!("more photos lie in {below}: name it, too, to take them"));
    }
    Ok(photos)
}

pub fn directly_in(folder: &Path) -> Result<Vec<PathBuf>> {
    sorted(folder, |path| path.is_file() && is_photo(path))
}

pub fn folders_in(folder: &Path) -> Result<Vec<PathBuf>> {
    sorted(folder, |path| path.is_dir())
}

/// In natural order.
fn sorted(folder: &Path, is_kept: fn(&PathBuf) -> bool) -> Result<Vec<PathBuf>> {
    let mut found = visible(folder)?;
    found.retain(is_kept);
    found.sort_by(by_name);
    Ok(found)
}

/// Splits files into photos and others, such as HEIC pictures beside a photo of the same name.
fn photos_among(files: Vec<PathBuf>) -> (Vec<PathBuf>, Vec<PathBuf>) {
    let photos = files.iter().filter(|path| is_photo(path));
    let stems: HashSet<OsString> = photos.filter_map(|path| path.file_stem().map(OsString::from)).collect();
    let is_copied = |path: &PathBuf| path.file_stem().is_some_and(|stem| stems.contains(stem));
    files.into_iter().partition(|path| is_photo(path) || is_heic(path) && !is_copied(path))
}

/// Excludes hidden files, such as macOS's `._000.jpg`.
fn visible(folder: &Path) -> Result<Vec<PathBuf>> {
    let is_hidden = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
    Ok(entries(folder)?.into_iter().filter(|path| !is_hidden(path)).collect())
}

fn folders_of_photos(mut folders: Vec<PathBuf>) -> String {
    let has_photos = |folder: &PathBuf| visible(folder).is_ok_and(|files| files.iter().any(|file| is_photo(file)));
    folders.retain(has_photos);
    folders.sort_by(by_name);
    named(&folders, |folder| folder.join("").display().to_string())
}

/// Keeps at most `views` photos with known cameras, each once per view.
pub fn kept(
    session: &mut Session<'_>,
    photos: Vec<PathBuf>,
    known: Option<&mut KnownCameras>,
    views: Option<u32>,
) -> Result<Vec<PathBuf>> {
    let Some(known) = known else { return Ok(spread(photos, views)) };
    session.notes(&known.poses.warnings);
    let photos = spread(posed(session, photos, known)?, views);
    known.poses.attach(&photos)?;
    known.poses.per_view(photos)
}

pub fn posed(session: &mut Session<'_>, photos: Vec<PathBuf>, known: &KnownCameras) -> Result<Vec<PathBuf>> {
    let KnownCameras { poses, found } = known;
    // A found photo may have the name of a lost one.
    let lost = found.as_ref().map_or(&[][..], |found| &found.lost[..]);
    let (mut kept, mut others) = (Vec::new(), Vec::new());
    for photo in photos {
        let to = if !lost.contains(&photo) && poses.frame_of(&photo)?.is_some() { &mut kept } else { &mut others };
        to.push(photo);
    }
    if kept.is_empty() {
        // Reports the expected names of the first one.
        poses.frames_of(&others[..others.len().min(1)])?;
    }
    if !others.is_empty() {
        session.note(format!("{} left out, not among the cameras: {}", counted(others.len(), "photo"), names(&others)));
    }
    Ok(kept)
}

/// At most `count`, evenly spread, ends included.
pub fn spread(photos: Vec<PathBuf>, count: Option<u32>) -> Vec<PathBuf> {
    let count = count.map_or(photos.len(), |count| count as usize);
    if photos.len() <= count {
        return photos;
    }
    let (last, steps) = (photos.len() - 1, (count - 1).max(1));
    (0..count).map(|i| photos[(i * last + steps / 2) / steps].clone()).collect()
}

/// Photos opened when needed, with `frames` as by [`CaptureView::open`]: COLMAP's cameras ignore
/// the EXIF orientation.
pub struct PhotoFiles<'a> {
    paths: &'a [PathBuf],
    frames: &'a [&'a CaptureView],
    masks: Option<Masks>,
    sizes: Vec<[u32; 2]>,
}

impl<'a> PhotoFiles<'a> {
    /// Reads the sizes of photos.
    pub fn new(paths: &'a [PathBuf], frames: &'a [&'a CaptureView], masks: Option<Masks>) -> Result<Self> {
        let size = |(i, path): (usize, &PathBuf)| match frames.get(i) {
            None => Image::size(path).map(<[u32; 2]>::from),
            Some(frame) => Ok(frame.size(Image::size_as_stored(path)?.into())),
        };
        let sizes = paths.par_iter().enumerate().map(size);
        Ok(Self { paths, frames, masks, sizes: sizes.collect::<Vec<_>>().into_iter().collect::<Result<_>>()? })
    }
}

impl Photos for PhotoFiles<'_> {
    fn count(&self) -> usize {
        self.paths.len()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        self.sizes[i]
    }

    fn open(&self, i: usize) -> Result<Cow<'_, Image>> {
        open(&self.paths[i], self.frames.get(i), self.masks.as_ref()).map(Cow::Owned)
    }
}

pub fn open(path: &Path, frame: Option<&&CaptureView>, masks: Option<&Masks>) -> Result<Image> {
    match (frame, masks) {
        (None, None) => Image::open(path),
        (None, Some(masks)) => masks.open(path, false),
        (Some(frame), None) => frame.open(path),
        (Some(frame), Some(masks)) => frame.open_masked(path, masks),
    }
}

/// Reads photos concurrently.
pub fn read<T: Send>(
    photos: &[PathBuf],
    frames: &[&CaptureView],
    masks: Option<&Masks>,
    stage: &Stage<'_>,
    make: impl Fn(usize, Image) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let done = AtomicUsize::new(0);
    let read = |(i, path): (usize, &PathBuf)| {
        let made = make(i, open(path, frames.get(i), masks)?)?;
        let done = 1 + done.fetch_add(1, atomic::Ordering::Relaxed);
        stage.reach(done as f64 / photos.len() as f64)?;
        Ok(made)
    };
    photos.par_iter().enumerate().map(read).collect::<Vec<_>>().into_iter().collect()
}

pub fn cropping(photos: &[[u32; 2]], Size(width, height): Size) -> Option<String> {
    let area = |width: u32, height: u32| f64::from(width) * f64::from(height);
    let kept = |[w, h]: &[u32; 2]| {
        let rect = crop_to_aspect(*w, *h, f64::from(width) / f64::from(height));
        area(rect.width, rect.height)
    };
    let all: f64 = photos.iter().map(|[w, h]| area(*w, *h)).sum();
    let cropped_share = 1.0 - photos.iter().map(kept).sum::<f64>() / all;
    (cropped_share > CROPPED).then(|| format!("{:.0} % of the photos' area is cropped away", 100.0 * cropped_share))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_keeps_the_ends() {
        let names = |count: u32, of: usize| -> Vec<String> {
            let photos = (0..of).map(|i| PathBuf::from(i.to_string())).collect();
            spread(photos, Some(count)).iter().map(|path| path.display().to_string()).collect()
        };
        assert_eq!(names(3, 9), ["0", "4", "8"]);
        assert_eq!(names(4, 6), ["0", "2", "3", "5"]);
        assert_eq!(names(1, 6), ["0"]);
        assert_eq!(names(6, 2), ["0", "1"]);
    }
}
