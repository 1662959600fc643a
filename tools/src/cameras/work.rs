use super::colmap::{KEYFRAMES, MASKS, PAIRS};
use crate::{decode::exif_of, outputs::make_folder, scratch::Scratch, session::Stage};
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{
        Image, Masks, check_jpeg_end, open_file,
        poses::{Capture, CaptureView},
    },
};

/// Distances of COLMAP 3.8's sequential matching; later versions only keep the powers of two.
const NEIGHBORS: [usize; 15] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 32, 64, 128, 256, 512];

/// Under short names for COLMAP's files.
pub(super) struct Work {
    pub folder: Scratch,
    pub photos: Vec<(PathBuf, String)>,
}

impl Work {
    /// Photos of one size and lens share a folder and intrinsics. JPEG and PNG are linked; others
    /// become PNG.
    pub fn new(photos: &[PathBuf], masks: Option<&Masks>, stage: &Stage<'_>) -> Result<Self> {
        masks.map_or(Ok(()), |masks| masks.check(photos))?;
        let cameras = lenses(photos)?;
        let mut work = Self { folder: Scratch::new()?, photos: Vec::new() };
        stage.each(&photos.iter().enumerate().collect::<Vec<_>>(), |(number, photo)| {
            let (kind, camera) = (kind(photo)?, cameras[*number]);
            let name = format!("{camera}/{number:06}.{}", kind.unwrap_or("png"));
            let path = work.folder.path().join("images").join(&name);
            make_folder(path.parent().unwrap_or(&path))?;
            match kind {
                Some(_) => link(photo, &path)?,
                None => Image::open_as_stored(photo)?.save_png(&path)?,
            }
            if let Some(masks) = masks {
                let Image { width, height, mask, .. } = masks.open(photo, true)?;
                let path = work.folder.path().join(MASKS).join(format!("{name}.png"));
                make_folder(path.parent().unwrap_or(&path))?;
                Image::new(width, height, mask.iter().flatten().flat_map(|value| [*value; 3]).collect())?
                    .save_png(&path)?;
            }
            work.photos.push(((*photo).clone(), name));
            Ok(())
        })?;
        Ok(work)
    }

    /// Lists at most `most` evenly spaced keyframes and returns their number. Also lists the pairs,
    /// unless COLMAP's sequential matcher suits: it sorts by name, and so by lens.
    pub fn choose_keyframes(&self, most: usize) -> Result<usize> {
        let count = self.photos.len();
        let distance = count.div_ceil(most);
        if distance > 1 {
            self.list(KEYFRAMES, self.photos.iter().step_by(distance).map(|(_, name)| name.clone()))?;
        }
        if distance > 1 || !self.photos.is_sorted_by_key(|(_, name)| name) {
            self.list_pairs(distance)?;
        }
        Ok(count.div_ceil(distance))
    }

    /// Lists pairs to match. Every `distance`-th photo is a keyframe, paired as in sequential
    /// matching. Other photos pair with surrounding keyframes.
    pub fn list_pairs(&self, distance: usize) -> Result<()> {
        let count = self.photos.len();
        let partners = |i: usize| match i % distance {
            0 => NEIGHBORS.iter().map(|far| i + far * distance).collect(),
            after => vec![i - after, i - after + distance],
        };
        let pairs = (0..count).flat_map(|i| partners(i).into_iter().map(move |j| (i, j)));
        let names = |(i, j): (usize, usize)| format!("{} {}", self.photos[i].1, self.photos[j].1);
        self.list(PAIRS, pairs.filter(|(_, j)| *j < count).map(names))
    }

    fn list(&self, file: &str, lines: impl Iterator<Item = String>) -> Result<()> {
        let path = self.folder.path().join(file);
        std::fs::write(&path, lines.collect::<Vec<_>>().join("\n")).map_err(|source| Error::io(&path, source))
    }

    /// Also returns the photos without a camera. Names are the photos' own paths.
    pub fn named(&self, model: Capture) -> Result<(Capture, Vec<PathBuf>)> {
        let mut frames: HashMap<String, CaptureView> =
            model.frames.into_iter().map(|frame| (frame.name.clone(), frame)).collect();
        let mut poses = Capture { points: model.points, warnings: model.warnings, ..Capture::default() };
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
            poses.frames.push(CaptureView {
                name: photo.to_string_lossy().into_owned(),
                photo: Some(photo.clone()),
                ..frame
            });
        }
        Ok((poses, lost))
    }
}

/// `None` for formats that some COLMAP lacks. Rejects truncated JPEGs, which COLMAP accepts.
fn kind(photo: &Path) -> Result<Option<&'static str>> {
    let mut start = [0; 4];
    let read = std::io::Read::read_exact(&mut open_file(photo)?, &mut start);
    read.map_err(|source| Error::io(photo, source))?;
    Ok(match start {
        [0xff, 0xd8, ..] => {
            check_jpeg_end(photo)?;
            Some("jpg")
        }
        [0x89, b'P', b'N', b'G'] => Some("png"),
        _ => None,
    })
}

fn link(photo: &Path, to: &Path) -> Result<()> {
    let failed = |source| Error::io(photo, source);
    let photo = photo.canonicalize().map_err(failed)?;
    #[cfg(unix)]
    let linked = std::os::unix::fs::symlink(&photo, to);
    #[cfg(not(unix))]
    let linked = std::fs::hard_link(&photo, to).or_else(|_| std::fs::copy(&photo, to).map(drop));
    linked.map_err(failed)
}

/// Counts from 0. Photos of equal size, EXIF camera and focal length share one.
pub fn lenses(photos: &[PathBuf]) -> Result<Vec<usize>> {
    let mut known = HashMap::new();
    let lens = |photo: &PathBuf| {
        let count = known.len();
        Ok(*known.entry((Image::size_as_stored(photo)?, optics(photo))).or_insert(count))
    };
    photos.iter().map(lens).collect()
}

/// A phone may have several lenses.
fn optics(photo: &Path) -> Option<String> {
    let read = exif_of(photo)?;
    let tags = [exif::Tag::Model, exif::Tag::FocalLength, exif::Tag::FocalLengthIn35mmFilm];
    let value = |tag| read.get_field(tag, exif::In::PRIMARY).map(|field| field.display_value().to_string());
    Some(tags.map(|tag| value(tag).unwrap_or_default()).join(" "))
}
