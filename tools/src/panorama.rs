//! 360-degree photos without known cameras, cut into pinhole photos.

use crate::{
    decode::save_jpeg_of_focal,
    file_names::{names, unique_stems},
    masks::MaskArgs,
    outputs::make_folder,
    session::Session,
};
use clap::ValueEnum;
use std::{
    io::Read,
    path::{Path, PathBuf},
};
use zipsplat::{
    Error, Result,
    types::{CUT_VIEW_DEG, Image, Lens, MaskSource, Masks, open_file},
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CameraModel {
    /// Photos as they are
    Pinhole,
    /// 360-degree photos, twice as wide as high
    Equirectangular,
}

/// Start of a file that has its metadata.
const METADATA: u64 = 1 << 18;
/// Google's Photo Sphere metadata in XMP.
const PROJECTION: &[u8] = b"GPano:ProjectionType";
const EQUIRECTANGULAR: &[u8] = b"equirectangular";
/// Width of 35 mm film.
const FILM: f64 = 36.0;

fn states_equirectangular(photo: &Path) -> bool {
    let mut start = Vec::new();
    let read = open_file(photo).is_ok_and(|file| file.take(METADATA).read_to_end(&mut start).is_ok());
    let find = |text: &[u8], word: &[u8]| text.windows(word.len()).position(|part| part == word);
    read && find(&start, PROJECTION).is_some_and(|at| {
        let value = &start[at + PROJECTION.len()..];
        // `="equirectangular"` or `>equirectangular</`.
        find(&value[..value.len().min(EQUIRECTANGULAR.len() + 4)], EQUIRECTANGULAR).is_some()
    })
}

fn is_whole(photo: &Path) -> Result<bool> {
    Image::size(photo).map(|(width, height)| u64::from(width) == 2 * u64::from(height))
}

pub fn find(session: &mut Session<'_>, photos: &[PathBuf], model: Option<CameraModel>) -> Result<Vec<bool>> {
    if let Some(model) = model {
        return Ok(vec![model == CameraModel::Equirectangular; photos.len()]);
    }
    let (mut found, mut parts) = (Vec::new(), Vec::new());
    for photo in photos {
        let is_stated = states_equirectangular(photo);
        let is_found = is_stated && is_whole(photo)?;
        parts.extend((is_stated && !is_found).then(|| photo.clone()));
        found.push(is_found);
    }
    if !parts.is_empty() {
        let why = "panoramas of less than the sphere are taken as pinhole photos";
        session.note(format!("{why}: {}", names(&parts)));
    }
    Ok(found)
}

pub fn refuse(photos: &[PathBuf]) -> Result<()> {
    let is_found = |photo: &&PathBuf| states_equirectangular(photo) && is_whole(photo).unwrap_or(false);
    photos.iter().find(is_found).map_or(Ok(()), |photo| {
        let expected = "pinhole photos, or known cameras of the model EQUIRECTANGULAR; \
                        reconstruct --cameras colmap cuts such photos";
        Err(Error::argument(format!("photo {}", photo.display()), "an equirectangular 360-degree photo", expected))
    })
}

/// Writes the pinhole views of 360-degree photos, such as `pano-0.jpg` to `pano-7.jpg`, and of
/// their masks. Lists the views instead of the photos.
pub fn cut(
    session: &mut Session<'_>,
    photos: &[PathBuf],
    is_panorama: &[bool],
    mask_args: &MaskArgs,
    folder: &Path,
) -> Result<Vec<PathBuf>> {
    let masks = mask_args.given();
    masks.as_ref().map_or(Ok(()), |masks| masks.check(photos))?;
    let mask_folder = folder.join("masks");
    masks.as_ref().map_or(Ok(()), |_| make_folder(&mask_folder))?;
    let save_mask = |photo: &Path, image: &Image| {
        let Image { width, height, mask: Some(mask), .. } = image else { return Ok(()) };
        let mut name = photo.file_name().unwrap_or_default().to_owned();
        name.push(".png");
        let rgb = mask.iter().flat_map(|value| [*value; 3]).collect();
        Image::new(*width, *height, rgb)?.save_png(mask_folder.join(name))
    };
    let stems = unique_stems(photos);
    let numbered: Vec<(usize, &PathBuf)> = photos.iter().enumerate().collect();
    let (written, _) = session.stage("cut photos", |stage| {
        stage.each(&numbered, |(i, photo)| {
            if !is_panorama[*i] {
                let masked = masks.as_ref().map(|masks| masks.open(photo, true)).transpose()?;
                masked.map_or(Ok(()), |image| save_mask(photo, &image))?;
                return Ok(vec![(*photo).clone()]);
            }
            let image = masks.as_ref().map_or_else(|| Image::open(photo), |masks| masks.open(photo, false))?;
            let lens = Lens::equirectangular(image.width, image.height, &photo.display().to_string())?;
            let focal = (FILM / 2.0 / (CUT_VIEW_DEG / 2.0).to_radians().tan()).round() as u16;
            let mut views = Vec::new();
            for view in 0..lens.view_count() {
                let picture = Lens { view, ..lens }.undistort(&image)?;
                if picture.mask.as_ref().is_some_and(|mask| mask.iter().all(|value| *value == 0)) {
                    continue;
                }
                let path = folder.join(format!("{}-{view}.jpg", stems[*i]));
                save_jpeg_of_focal(&picture, focal, &path)?;
                save_mask(&path, &picture)?;
                views.push(path);
            }
            Ok(views)
        })
    })?;
    let cut = is_panorama.iter().filter(|is_panorama| **is_panorama).count();
    let views = written.concat();
    session.note(format!(
        "360-degree photos, {cut} of them, are cut into {} pinhole photos of {CUT_VIEW_DEG} degrees",
        views.len() + cut - photos.len()
    ));
    if masks.is_some() {
        mask_args.replace(Masks { source: MaskSource::Folder(mask_folder), inverted: false });
    }
    Ok(views)
}
