use super::{FromPhotos, cameras::InputCamera, page::ShownScene, photos::input_cameras};
use crate::{
    depth::{PredictorOptions, check_finds_cameras},
    options::{DEPTH_WEIGHTS, refuse},
    photos::Photographed,
    session::{Session, Stage},
    video::FrameFolder,
    views::Crop,
};
use std::path::{Path, PathBuf};
use zipsplat::{
    Result,
    reconstruct::Ratio,
    types::{Scene, poses::CaptureView},
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
        paths: &[PathBuf],
        poses: Option<&Path>,
    ) -> Result<OfPixels> {
        for (option, given) in [
            ("--crop tiles", self.crop.crop == Crop::Tiles),
            ("--scene-scale", self.scene_scale.is_some()),
            ("--refine", self.refines()),
            ("--ratio", self.quality.ratio != Ratio::Fixed(1.0)),
        ] {
            let expected =
                if option == "--ratio" { "weights of ZipSplat; --ratios R,R,.." } else { "weights of ZipSplat" };
            refuse(option, given, DEPTH_WEIGHTS, expected)?;
        }
        self.quality.check_pixels(checkpoint)?;
        if poses.is_none() {
            check_finds_cameras(checkpoint.architecture())?;
        }
        let Photographed { photos, known, folder } = self.photographed(session, paths, poses)?;
        let poses = known.as_ref().map(|known| &known.poses);
        let frames = poses.map(|poses| poses.frames_of(&photos)).transpose()?.unwrap_or_default();
        let masks = self.finding.masks();
        let options = self.quality.predictor_options(checkpoint);
        let options = PredictorOptions { masks, cameras: self.finding.cameras, ..options };
        let (prepared, _) = session.stage("load photos", |stage| options.read(&photos, &frames, stage))?;
        let ratios = self.ratios(prepared.patches(checkpoint.architecture().backbone.patch_size))?;
        let device = session.device()?;
        let mut predictor = options.open(session, &device)?;
        let (mut scenes, mut cameras) = (Vec::new(), Vec::new());
        for ratio in ratios {
            predictor.request.ratio = Ratio::Fixed(ratio);
            let predict = |stage: &Stage<'_>| predictor.predict(prepared.clone(), stage);
            let (mut predicted, _) = session.stage("depth", predict)?;
            predicted.scale(false, poses.and_then(|poses| poses.points.as_deref()))?;
            let frames: Vec<CaptureView> = if frames.is_empty() {
                predicted.frames()?
            } else {
                frames.iter().map(|frame| (*frame).clone()).collect()
            };
            let scene = predicted.scene(&frames[0].camera.pose, self.quality.kept())?;
            let times =
                predicted.times.iter().map(|(step, took)| ((*step).to_owned(), 1e3 * took.as_secs_f64())).collect();
            scenes.push((ShownScene { name: format!("ratio {ratio}"), times, ..ShownScene::default() }, scene));
            if cameras.is_empty() {
                session.notes(&predicted.notes);
                cameras = input_cameras(&predicted.photos, &frames.iter().collect::<Vec<_>>());
            }
        }
        Ok(OfPixels { scenes, cameras, _folder: folder })
    }
}
