//! Pixel scenes for a page.

use super::{
    FromPhotos,
    cameras::InputCamera,
    page::ShownScene,
    photos::{Photographed, input_cameras},
};
use crate::{
    depth::{Shown, check_finds_cameras},
    options::refuse,
    session::{Session, Stage},
    video::FrameFolder,
    views::Fit,
};
use std::path::{Path, PathBuf};
use zipsplat::{
    Result,
    reconstruct::Ratio,
    types::{Scene, poses::Frame},
    weights::DepthCheckpoint,
};

/// By ratio, with the photos' cameras in their world.
pub struct OfPixels {
    pub scenes: Vec<(ShownScene, Scene)>,
    pub cameras: Vec<InputCamera>,
    /// Keeps the frames of a video.
    _folder: Option<FrameFolder>,
}

impl FromPhotos {
    pub fn of_pixels(
        &self,
        session: &mut Session<'_>,
        checkpoint: &DepthCheckpoint,
        (paths, poses): (&[PathBuf], Option<&Path>),
    ) -> Result<OfPixels> {
        for (option, given) in [
            ("--fit squares", self.fit.fit == Fit::Squares),
            ("--unit", self.unit.is_some()),
            ("--refine", self.refines()),
            ("--ratio", self.quality.ratio != Ratio::Fixed(1.0)),
        ] {
            let expected =
                if option == "--ratio" { "weights of ZipSplat; --ratios R,R,.." } else { "weights of ZipSplat" };
            refuse(option, given, "weights of Depth Anything 3", expected)?;
        }
        self.quality.check_pixels(checkpoint)?;
        if poses.is_none() {
            check_finds_cameras(checkpoint.architecture())?;
        }
        let Photographed { photos, known, folder } = self.photographed(session, paths, poses)?;
        let poses = known.as_ref().map(|known| &known.poses);
        let frames = poses.map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        let side = self.quality.side();
        let (shown, _) = session.stage("load photos", |stage| Shown::read(side, &photos, &frames, stage))?;
        let ratios = self.ratios(shown.patches(checkpoint.architecture().backbone.patch))?;
        let device = session.device()?;
        let mut seer = self.quality.question(checkpoint).open(session, &device)?;
        let (mut scenes, mut cameras) = (Vec::new(), Vec::new());
        for ratio in ratios {
            seer.keep(Ratio::Fixed(ratio));
            let see = |stage: &Stage<'_>| seer.see(shown.clone(), stage);
            let (mut seen, _) = session.stage("depth", see)?;
            seen.scale(false, poses.and_then(|poses| poses.points.as_deref()))?;
            let frames: Vec<Frame> =
                if frames.is_empty() { seen.frames()? } else { frames.iter().map(|frame| (*frame).clone()).collect() };
            let scene = seen.scene(&frames[0].camera.pose, self.quality.kept())?;
            let times = seen.times.iter().map(|(step, took)| ((*step).to_owned(), 1e3 * took.as_secs_f64())).collect();
            scenes.push((ShownScene { name: format!("ratio {ratio}"), times, ..ShownScene::default() }, scene));
            if cameras.is_empty() {
                session.notes(&seen.notes);
                cameras = input_cameras(&seen.photos, &frames.iter().collect::<Vec<_>>());
            }
        }
        Ok(OfPixels { scenes, cameras, _folder: folder })
    }
}
