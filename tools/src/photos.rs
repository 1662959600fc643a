//! Photos from files and folders to views of the network's size.

use crate::{
    heic::{is_heic, to_jpeg},
    options::Size,
    outputs::Overwrite,
    session::{Session, Stage},
    table::counted,
    video::{FRAMES, FrameFolder, is_video, sharpest_frames},
};
use clap::Args;
use rayon::prelude::*;
use std::{
    cmp::Ordering,
    collections::HashSet,
    ffi::OsString,
    path::{Path, PathBuf},
    sync::atomic::{self, AtomicUsize},
};
use zipsplat::{
    Error, Result,
    types::{
        Image,
        poses::{Frame, Poses},
        preprocess::crop_to_aspect,
    },
};

/// Extensions of the files of a folder that are taken for photos.
const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];
/// Files or folders that a message names.
const NAMED: usize = 5;
/// Share of the photos' area that may be cropped away without a word.
const CROPPED: f64 = 0.1;

/// The photos of a command.
#[derive(Args)]
pub struct PhotoArgs {
    /// Photos (PNG, JPEG, WebP; HEIC where ffmpeg reads it), folders of them, taken in natural order of their names, or videos, of
    /// which the sharpest frames are taken
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    #[command(flatten)]
    reading: Reading,
}

/// How folders and videos are read.
#[derive(Args)]
pub struct Reading {
    /// Also take the photos of folders in folders
    #[arg(long)]
    recursive: bool,
    /// Program that reads videos and HEIC
    #[arg(long, value_name = "PROGRAM", default_value = "ffmpeg")]
    pub ffmpeg: PathBuf,
}

impl PhotoArgs {
    /// As [`Reading::list`].
    ///
    /// # Errors
    /// As [`Reading::list`].
    pub fn list(
        &self,
        session: &mut Session<'_>,
        frames: Option<u32>,
        named_in: Option<(&Path, Overwrite)>,
    ) -> Result<(Vec<PathBuf>, Option<FrameFolder>)> {
        self.reading.list(session, &self.photos, frames, named_in)
    }
}

impl Reading {
    /// The photos as [`list`] has them, and the folder of those that ffmpeg makes: of each video `frames`, or a usual number, and of
    /// HEIC pictures JPEG. The folder lies beside the file that will name them, where there is one, and may exist where that says so.
    ///
    /// # Errors
    /// As [`list`], [`FrameFolder`], [`sharpest_frames`] and [`to_jpeg`].
    pub fn list(
        &self,
        session: &mut Session<'_>,
        paths: &[PathBuf],
        frames: Option<u32>,
        named_in: Option<(&Path, Overwrite)>,
    ) -> Result<(Vec<PathBuf>, Option<FrameFolder>)> {
        let mut listed = Vec::new();
        for path in paths {
            if is_video(path) {
                listed.push(path.clone());
            } else {
                listed.extend(list_path(session, path, self.recursive)?);
            }
        }
        let heic: Vec<&PathBuf> = listed.iter().filter(|path| is_heic(path)).collect();
        let beside = |(file, overwrite): (&Path, Overwrite)| FrameFolder::beside(file, overwrite.is_given());
        let make = || named_in.map_or_else(FrameFolder::temporary, beside);
        let needed = !heic.is_empty() || listed.iter().any(|path| is_video(path));
        let Some(folder) = needed.then(make).transpose()? else { return Ok((listed, None)) };
        let mut made = match heic[..] {
            [] => Vec::new(),
            _ => to_jpeg(session, &self.ffmpeg, &heic, folder.path())?,
        }
        .into_iter();
        let mut photos = Vec::new();
        for path in &listed {
            if is_video(path) {
                let count = frames.map_or(FRAMES, |frames| frames as usize);
                photos.extend(sharpest_frames(session, &self.ffmpeg, path, count, folder.path())?);
            } else if is_heic(path) {
                photos.extend(made.next());
            } else {
                photos.push(path.clone());
            }
        }
        Ok((photos, Some(folder)))
    }
}

/// The photos that `paths` stand for: files as they are, of folders the photos inside by natural order. Other files of a
/// folder are left out, which is noted, but for hidden ones.
///
/// # Errors
/// Where a path does not exist or a folder has no photo.
pub fn list(session: &mut Session<'_>, paths: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut photos = Vec::new();
    for path in paths {
        photos.extend(list_path(session, path, false)?);
    }
    Ok(photos)
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
        let expected = format!("files that end in {}", EXTENSIONS.join(", "));
        return Err(Error::argument(format!("photos in {} and below", path.display()), "none", expected));
    }
    Ok(photos)
}

/// The photos of a folder, then those of each folder in it; links to folders are not followed, which may lead round.
fn list_below(folder: &Path, photos: &mut Vec<PathBuf>) -> Result<()> {
    let mut entries = visible(folder)?;
    entries.sort_by(by_name);
    let files = entries.iter().filter(|path| path.is_file()).cloned().collect();
    photos.extend(photos_among(files).0);
    entries.iter().filter(|path| path.is_dir() && !path.is_symlink()).try_for_each(|path| list_below(path, photos))
}

/// The natural order of paths.
fn by_name(a: &PathBuf, b: &PathBuf) -> Ordering {
    natural(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b))
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
        // What it is, and how it is converted, says more than that it is not what was looked for.
        others.first().map_or(Ok((0, 0)), Image::size)?;
        let expected = format!("files that end in {}", EXTENSIONS.join(", "));
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

/// The photos that lie in a folder itself, in natural order; there may be none.
///
/// # Errors
/// Where the folder cannot be read.
pub fn directly_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = visible(folder)?;
    found.retain(|path| path.is_file() && is_photo(path));
    found.sort_by(by_name);
    Ok(found)
}

/// The folders in a folder, in natural order.
///
/// # Errors
/// Where the folder cannot be read.
pub fn folders_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = visible(folder)?;
    found.retain(|path| path.is_dir());
    found.sort_by(by_name);
    Ok(found)
}

/// Splits files into photos and others. A HEIC picture beside a photo of the same name is its
/// original, and no second photo.
fn photos_among(files: Vec<PathBuf>) -> (Vec<PathBuf>, Vec<PathBuf>) {
    let stems: HashSet<OsString> =
        files.iter().filter(|path| is_photo(path)).filter_map(|path| Some(path.file_stem()?.to_owned())).collect();
    let is_copied = |path: &PathBuf| path.file_stem().is_some_and(|stem| stems.contains(stem));
    files.into_iter().partition(|path| is_photo(path) || is_heic(path) && !is_copied(path))
}

/// The files and folders of a folder, but for hidden ones. Those are no photos whatever they are called: macOS puts `._000.jpg`
/// beside `000.jpg` on foreign disks.
fn visible(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |error| Error::io(folder, error);
    let mut found = Vec::new();
    for entry in folder.read_dir().map_err(failed)? {
        let entry = entry.map_err(failed)?;
        if !entry.file_name().to_string_lossy().starts_with('.') {
            found.push(entry.path());
        }
    }
    Ok(found)
}

fn is_photo(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str()))
}

/// The folders among these that have photos directly in them, for messages.
fn folders_of_photos(mut folders: Vec<PathBuf>) -> String {
    let has_photos = |folder: &PathBuf| visible(folder).is_ok_and(|files| files.iter().any(|file| is_photo(file)));
    folders.retain(has_photos);
    folders.sort_by(by_name);
    named(&folders, |folder| folder.join("").display().to_string())
}

/// The first few of some paths, by what `name` calls them.
fn named(paths: &[PathBuf], name: impl Fn(&PathBuf) -> String) -> String {
    let mut names: Vec<String> = paths.iter().take(NAMED).map(name).collect();
    if paths.len() > NAMED {
        names.push("...".into());
    }
    names.join(", ")
}

/// The photos that have a camera among `poses`. The others are left out, which is noted: structure from motion seldom places
/// every photo.
///
/// # Errors
/// Where none has a camera, or one may have several.
pub fn posed(session: &mut Session<'_>, photos: Vec<PathBuf>, poses: &Poses) -> Result<Vec<PathBuf>> {
    let (mut kept, mut others) = (Vec::new(), Vec::new());
    for photo in photos {
        let to = if poses.frame_of(&photo)?.is_some() { &mut kept } else { &mut others };
        to.push(photo);
    }
    if kept.is_empty() {
        // Says for the first of them which names were looked for.
        poses.frames_of(&others[..others.len().min(1)])?;
    }
    if !others.is_empty() {
        session.note(format!("{} left out, not among the cameras: {}", counted(others.len(), "photo"), names(&others)));
    }
    Ok(kept)
}

/// The first few of the files by name.
pub fn names(files: &[PathBuf]) -> String {
    named(files, |path| path.file_name().unwrap_or_default().to_string_lossy().into_owned())
}

/// `count` of the photos at most, evenly spread, the first and the last among them.
pub fn spread(photos: Vec<PathBuf>, count: usize) -> Vec<PathBuf> {
    if photos.len() <= count {
        return photos;
    }
    let (last, steps) = (photos.len() - 1, (count - 1).max(1));
    (0..count).map(|i| photos[(i * last + steps / 2) / steps].clone()).collect()
}

/// Orders numbers in names by value: `2.png` before `10.png`.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let (Some(x), Some(y)) = (a.chars().next(), b.chars().next()) else { return a.len().cmp(&b.len()) };
        let number = x.is_ascii_digit() && y.is_ascii_digit();
        let split =
            |text: &str| if number { end_of_digits(text) } else { text.chars().next().map_or(0, char::len_utf8) };
        let ((head_a, rest_a), (head_b, rest_b)) = (a.split_at(split(a)), b.split_at(split(b)));
        let order = if number {
            let value = |digits: &str| digits.trim_start_matches('0').to_owned();
            let (va, vb) = (value(head_a), value(head_b));
            va.len().cmp(&vb.len()).then(va.cmp(&vb))
        } else {
            head_a.cmp(head_b)
        };
        if order.is_ne() {
            return order;
        }
        (a, b) = (rest_a, rest_b);
    }
}

fn end_of_digits(text: &str) -> usize {
    text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len())
}

/// Reads photos and gives what `make` makes of each, by its index, several at once. Those that have `frames`, one each, are
/// read as [`Frame::open`] does: cameras of COLMAP, and of what is built on it, are of a photo's pixels before its EXIF
/// orientation is applied.
///
/// # Errors
/// The first photo's, in their order, that cannot be read, and those of `make`.
pub fn read<T: Send>(
    photos: &[PathBuf],
    frames: &[&Frame],
    stage: &Stage<'_>,
    make: impl Fn(usize, Image) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let done = AtomicUsize::new(0);
    let read = |(i, path): (usize, &PathBuf)| {
        let photo = frames.get(i).map_or_else(|| Image::open(path), |frame| frame.open(path));
        let made = make(i, photo?)?;
        let done = 1 + done.fetch_add(1, atomic::Ordering::Relaxed);
        stage.reach(done as f64 / photos.len() as f64)?;
        Ok(made)
    };
    photos.par_iter().enumerate().map(read).collect::<Vec<_>>().into_iter().collect()
}

/// The warning where much of photos of these sizes is cropped away to that of the network's input.
pub fn cropping(photos: &[[u32; 2]], Size(width, height): Size) -> Option<String> {
    let area = |width: u32, height: u32| f64::from(width) * f64::from(height);
    let kept = |[w, h]: &[u32; 2]| {
        let rect = crop_to_aspect(*w, *h, f64::from(width) / f64::from(height));
        area(rect.width, rect.height)
    };
    let all: f64 = photos.iter().map(|[w, h]| area(*w, *h)).sum();
    let share = 1.0 - photos.iter().map(kept).sum::<f64>() / all;
    (share > CROPPED).then(|| format!("{:.0} % of the photos' area is cropped away", 100.0 * share))
}

#[cfg(test)]
mod tests {
    use super::{natural, spread};
    use std::path::PathBuf;

    #[test]
    fn numbers_count_by_value() {
        let mut names = ["b1", "a10", "a2", "a02b", "a", "é1"];
        names.sort_by(|a, b| natural(a, b));
        assert_eq!(names, ["a", "a2", "a02b", "a10", "b1", "é1"]);
    }

    #[test]
    fn spread_keeps_the_ends() {
        let names = |count: usize, of: usize| -> Vec<String> {
            let photos = (0..of).map(|i| PathBuf::from(i.to_string())).collect();
            spread(photos, count).iter().map(|path| path.display().to_string()).collect()
        };
        assert_eq!(names(3, 9), ["0", "4", "8"]);
        assert_eq!(names(4, 6), ["0", "2", "3", "5"]);
        assert_eq!(names(1, 6), ["0"]);
        assert_eq!(names(6, 2), ["0", "1"]);
    }
}
