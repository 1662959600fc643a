//! Network views of photos: center crops, or square tiles.

use crate::{options::Size, photos, protocol::Filter, session::Stage, table::counted};
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    types::{
        Camera, Image, Masks, Pose,
        poses::CaptureView,
        preprocess::{View, fit},
        tile_count, tiles,
    },
};

#[derive(Args, Debug)]
pub struct CropOption {
    /// Part of a photo that the network sees, if its aspect ratio differs from --input-size
    #[arg(long, alias = "fit", value_enum, value_name = "HOW", default_value = "center")]
    pub crop: Crop,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Crop {
    /// Center crop, with the aspect ratio of --input-size
    #[value(alias = "crop")]
    Center,
    /// Whole photo, as square tiles with a rotated camera each. Needs known cameras; twice the
    /// views, time and memory up to 2:1
    #[value(alias = "squares")]
    Tiles,
}

#[derive(Clone, Copy, Debug)]
pub struct Seeing {
    pub crop: Crop,
    pub size: Size,
    pub compared: Size,
    /// Compares whole photos at the scale of `compared`, not crops.
    pub whole: bool,
    /// Of the compared photos.
    pub filter: Filter,
    /// Shorter side that photos are scaled down to first.
    pub source_side: Option<u32>,
}

pub struct Views {
    pub images: Vec<Image>,
    /// In the first photo's world; empty without known cameras.
    pub cameras: Vec<Camera>,
    pub note: Option<String>,
}

pub type NetworkInput = (Image, Option<Camera>);

impl Crop {
    pub fn check(self, size: Size, posed: bool) -> Result<()> {
        match self {
            Self::Tiles if !posed => {
                let expected = "known cameras: how one square is turned against the other has to be told";
                Err(Error::argument("--crop tiles", "photos without cameras", expected))
            }
            Self::Tiles if size.0 != size.1 => {
                Err(Error::argument("--crop tiles", size, "a --input-size as wide as high"))
            }
            _ => Ok(()),
        }
    }

    /// One frame each, or none.
    pub fn count(self, photos: &[PathBuf], frames: &[&CaptureView]) -> Result<usize> {
        if self == Self::Center {
            return Ok(photos.len());
        }
        let count = |(i, path): (usize, &PathBuf)| {
            let photo = Image::size_as_stored(path)?.into();
            let [width, height] = frames.get(i).map_or(photo, |frame| frame.size(photo));
            Ok(tile_count(width, height))
        };
        photos.iter().enumerate().map(count).sum()
    }

    pub fn views(self, photo: &Image, camera: Option<&Camera>, size: Size, label: &str) -> Result<Vec<NetworkInput>> {
        match (self, camera) {
            (Self::Tiles, Some(camera)) => {
                let views = tiles(photo, camera, size.0, label)?.into_iter();
                Ok(views.map(|(image, camera)| (image, Some(camera))).collect())
            }
            _ => {
                let view = fit(photo, size.0, size.1)?;
                let camera = camera.map(|camera| view.map.camera(camera, label)).transpose()?;
                Ok(vec![(view.image, camera)])
            }
        }
    }

    /// One frame each, or none.
    pub fn load(
        self,
        photos: &[PathBuf],
        frames: &[&CaptureView],
        masks: Option<&Masks>,
        size: Size,
        stage: &Stage<'_>,
    ) -> Result<Views> {
        let read = photos::read(photos, frames, masks, stage, |i, photo| {
            let camera = frames.get(i).map(|frame| &frame.camera);
            let views = self.views(&photo, camera, size, &format!("camera {i}"))?;
            Ok(([photo.width, photo.height], views))
        })?;
        let (sizes, views): (Vec<_>, Vec<_>) = read.into_iter().unzip();
        let world = frames.first().map_or(Pose::IDENTITY, |frame| frame.camera.pose);
        Ok(Views::new(self, views.into_iter().flatten(), &world, &sizes, size))
    }

    /// Also returns the first one's pose in another world.
    pub fn network_cameras(self, cameras: Vec<Camera>) -> (Vec<Camera>, Option<Pose>) {
        match (self, cameras.first().map(|camera| camera.pose)) {
            (Self::Tiles, Some(first)) => {
                (cameras.iter().map(|camera| camera.relative_to(&first)).collect(), Some(first))
            }
            _ => (cameras, None),
        }
    }
}

impl Seeing {
    pub fn cropped(size: Size) -> Self {
        Self { crop: Crop::Center, size, compared: size, whole: false, filter: Filter::Lanczos, source_side: None }
    }

    pub fn source(self, photo: Image, camera: Camera, label: &str) -> Result<(Image, Camera)> {
        let side = photo.width.min(photo.height);
        let Some(source) = self.source_side.filter(|source| *source < side) else { return Ok((photo, camera)) };
        let scaled = |length: u32| (f64::from(length) * f64::from(source) / f64::from(side)).round() as u32;
        let View { image, map } = Filter::Bilinear.whole(&photo, scaled(photo.width), scaled(photo.height))?;
        let camera = map.camera(&camera, label)?;
        Ok((image, camera))
    }

    pub fn compare(self, photo: &Image) -> Result<View> {
        let Size(width, height) = self.compared;
        if self.whole { self.filter.whole(photo, width, height) } else { self.filter.cropped(photo, width, height) }
    }
}

impl Views {
    /// The first camera has the pose `world` in the cameras' world.
    pub fn new(
        crop: Crop,
        inputs: impl Iterator<Item = NetworkInput>,
        world: &Pose,
        photos: &[[u32; 2]],
        size: Size,
    ) -> Self {
        let (images, cameras): (Vec<_>, Vec<_>) = inputs.unzip();
        let cameras: Vec<Camera> = cameras.into_iter().flatten().collect();
        let note = match crop {
            Crop::Tiles => {
                let squares = counted(images.len(), "square");
                Some(format!("the network sees {} as {squares} of {size}", counted(photos.len(), "photo")))
            }
            Crop::Center => photos::cropping(photos, size).map(|note| {
                let hint =
                    if cameras.is_empty() { "" } else { "; --crop tiles shows the network all of it, in more views" };
                note + hint
            }),
        };
        Self { images, cameras: cameras.iter().map(|camera| camera.relative_to(world)).collect(), note }
    }
}
