//! The parts of photos that the network sees: the middle of each, or all of it as squares side by side.

use crate::{options::Size, photos, protocol::Filter, session::Stage, table::counted};
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    reconstruct::MAX_VIEWS,
    types::{
        Camera, Image, Pose,
        poses::Frame,
        preprocess::{PixelMap, View, fit},
        square_count, squares,
    },
};

/// How photos of another shape than the network's are fitted to it.
#[derive(Args, Debug)]
pub struct FitOption {
    /// Part of a photo that the network sees where it is not as wide as high
    #[arg(long, alias = "crop", value_enum, value_name = "HOW", default_value = "crop")]
    pub fit: Fit,
}

/// The part of a photo that the network sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Fit {
    /// The middle, in the shape of --size
    Crop,
    /// The whole photo, as square views side by side, each with a camera turned to it: for known cameras. Twice the views of photos up
    /// to 2:1, and the time and memory of so many
    #[value(alias = "tiles")]
    Squares,
}

/// How photos are seen by the network and compared.
#[derive(Clone, Copy, Debug)]
pub struct Seeing {
    /// The part of each photo that the network sees.
    pub fit: Fit,
    /// The size of the pictures that it sees.
    pub size: Size,
    /// Size at which photos are compared.
    pub compared: Size,
    /// Whether photos are compared as a whole, at the scale of `compared`, and not only what cropping to it leaves.
    pub whole: bool,
    /// How photos become small.
    pub filter: Filter,
}

/// The views of photos.
pub struct Views {
    /// Pictures of the network's size.
    pub images: Vec<Image>,
    /// Their cameras, in the world of the first photo's; none where photos have none.
    pub cameras: Vec<Camera>,
    /// The note about them.
    pub note: Option<String>,
}

/// A picture for the network, and its camera, where there is one.
pub type Seen = (Image, Option<Camera>);

impl Fit {
    /// Refuses what squares cannot be made for.
    ///
    /// # Errors
    /// [`Error::Argument`] for another size than a square, and for photos without cameras.
    pub fn check(self, size: Size, posed: bool) -> Result<()> {
        match self {
            Self::Squares if !posed => {
                let expected = "known cameras: how one square is turned against the other has to be told";
                Err(Error::argument("--fit squares", "photos without cameras", expected))
            }
            Self::Squares if size.0 != size.1 => {
                Err(Error::argument("--fit squares", size, "a --size as wide as high"))
            }
            _ => Ok(()),
        }
    }

    /// How many views these photos become; only their headers are read.
    ///
    /// # Errors
    /// Where a photo cannot be read, or the views are more than a reconstruction takes.
    pub fn count(self, photos: &[PathBuf]) -> Result<usize> {
        if self == Self::Crop {
            return Ok(photos.len());
        }
        let count = |path: &PathBuf| Image::size_as_stored(path).map(|(width, height)| square_count(width, height));
        let views = photos.iter().map(count).sum::<Result<usize>>()?;
        if views > MAX_VIEWS {
            let expected = format!("at most {MAX_VIEWS}; --views N takes N of the photos, --fit crop one view of each");
            return Err(Error::argument("squares", format!("{views} of {}", counted(photos.len(), "photo")), expected));
        }
        Ok(views)
    }

    /// The views of one photo, their cameras in the world of `camera`.
    ///
    /// # Errors
    /// Where the camera is not that of the photo.
    pub fn views(self, photo: &Image, camera: Option<&Camera>, size: Size, label: &str) -> Result<Vec<Seen>> {
        match (self, camera) {
            (Self::Squares, Some(camera)) => {
                let views = squares(photo, camera, size.0, label)?.into_iter();
                Ok(views.map(|(image, camera)| (image, Some(camera))).collect())
            }
            _ => {
                let view = fit(photo, size.0, size.1)?;
                let camera = camera.map(|camera| seen_through(camera, &view.map, label)).transpose()?;
                Ok(vec![(view.image, camera)])
            }
        }
    }

    /// Reads photos that have these frames, one each, or none, and makes views of them.
    ///
    /// # Errors
    /// Where a photo cannot be read or is not that of its camera.
    pub fn load(self, photos: &[PathBuf], frames: &[&Frame], size: Size, stage: &Stage<'_>) -> Result<Views> {
        let read = photos::read(photos, frames, stage, |i, photo| {
            let camera = frames.get(i).map(|frame| &frame.camera);
            let views = self.views(&photo, camera, size, &format!("camera {i}"))?;
            Ok(([photo.width, photo.height], views))
        })?;
        let (sizes, views): (Vec<_>, Vec<_>) = read.into_iter().unzip();
        let world = frames.first().map_or(Pose::IDENTITY, |frame| frame.camera.pose);
        Ok(Views::new(self, views.into_iter().flatten(), &world, &sizes, size))
    }

    /// Cameras as the network is told them, in the world of the first, and its pose where that is not the world they are in.
    pub fn told(self, cameras: Vec<Camera>) -> (Vec<Camera>, Option<Pose>) {
        match (self, cameras.first().map(|camera| camera.pose)) {
            (Self::Squares, Some(first)) => {
                let told = |camera: Camera| Camera { pose: camera.pose.relative_to(&first), ..camera };
                (cameras.into_iter().map(told).collect(), Some(first))
            }
            _ => (cameras, None),
        }
    }
}

impl Seeing {
    /// The middle of each photo, which is all that is compared.
    pub fn cropped(size: Size) -> Self {
        Self { fit: Fit::Crop, size, compared: size, whole: false, filter: Filter::Lanczos }
    }

    /// The pictures that the network sees of a photo.
    ///
    /// # Errors
    /// As [`Fit::views`].
    pub fn views(self, photo: &Image, camera: &Camera, label: &str) -> Result<Vec<Seen>> {
        match (self.fit, self.filter) {
            (Fit::Crop, Filter::Bilinear) => {
                let View { image, map } = self.filter.cropped(photo, self.size.0, self.size.1)?;
                Ok(vec![(image, Some(seen_through(camera, &map, label)?))])
            }
            _ => self.fit.views(photo, Some(camera), self.size, label),
        }
    }

    /// A photo as it is compared.
    ///
    /// # Errors
    /// As [`Filter::cropped`].
    pub fn compare(self, photo: &Image) -> Result<View> {
        let Size(width, height) = self.compared;
        if self.whole { self.filter.whole(photo, width, height) } else { self.filter.cropped(photo, width, height) }
    }
}

impl Views {
    /// The views whose cameras are in the world of photos of these sizes, in which the first one's camera has the pose `world`.
    pub fn new(fit: Fit, seen: impl Iterator<Item = Seen>, world: &Pose, photos: &[[u32; 2]], size: Size) -> Self {
        let (images, cameras): (Vec<_>, Vec<_>) = seen.unzip();
        let cameras: Vec<Camera> = cameras.into_iter().flatten().collect();
        let note = match fit {
            Fit::Squares => {
                let squares = counted(images.len(), "square");
                Some(format!("the network sees {} as {squares} of {size}", counted(photos.len(), "photo")))
            }
            Fit::Crop => photos::cropping(photos, size).map(|note| {
                let hint =
                    if cameras.is_empty() { "" } else { "; --fit squares shows the network all of it, in more views" };
                note + hint
            }),
        };
        let here = |camera: Camera| Camera { pose: camera.pose.relative_to(world), ..camera };
        Self { images, cameras: cameras.into_iter().map(here).collect(), note }
    }
}

/// The camera of a photo as that of what a map makes of it.
///
/// # Errors
/// Where it is not valid or not the photo's.
pub fn seen_through(camera: &Camera, map: &PixelMap, label: &str) -> Result<Camera> {
    camera.validate(label)?;
    Ok(Camera { intrinsics: map.apply(&camera.intrinsics, label)?, ..*camera })
}
