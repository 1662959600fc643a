use super::{
    Eval,
    evaluator::Evaluator,
    external_scene::{aligned, place},
    reconstruction::{Network, Reconstruction},
};
use crate::{
    cameras::Similarity,
    capture::{Choice, ViewSplit},
    depth::{PredictorOptions, check_finds_cameras, square},
    options::{DEPTH_WEIGHTS, Size, refuse_all},
    session::Session,
    views::Crop,
};
use zipsplat::{
    Result,
    types::{Pose, poses::Capture},
    weights::DepthCheckpoint,
};

impl Eval {
    /// Returns the compared size.
    pub(super) fn check_pixels(&self, checkpoint: &DepthCheckpoint) -> Result<Size> {
        let tokens = self.refine.steps().is_some_and(|steps| steps.tokens);
        let options = [("--crop tiles", self.crop.crop == Crop::Tiles), ("--refine-target tokens", tokens)];
        refuse_all(options, DEPTH_WEIGHTS, "weights of ZipSplat")?;
        self.quality.check_pixels(checkpoint)?;
        if self.pose_free {
            check_finds_cameras(checkpoint.architecture())?;
        }
        Ok(self.quality.input_size.unwrap_or(square(checkpoint)))
    }
}

impl Evaluator<'_> {
    /// Without known cameras, estimated ones place the scene.
    pub(super) fn of_pixels(
        &mut self,
        session: &mut Session<'_>,
        choice: &Choice,
        capture: &ViewSplit,
        checkpoint: &DepthCheckpoint,
    ) -> Result<Reconstruction> {
        let predictor = match self.predictor.take() {
            Some(predictor) => predictor,
            None => {
                let options = self.quality.predictor_options(checkpoint);
                PredictorOptions { cameras: self.eval.finding.cameras, ..options }.open(session, &self.device)?
            }
        };
        let predictor = self.predictor.insert(predictor);
        // An earlier variant may have opened it.
        (predictor.request.ratio, predictor.request.token_selection) =
            (self.quality.ratio, self.quality.token_selection.clone());
        let (inputs, pose_free) = (choice.input_frames(), self.eval.pose_free);
        let known = if pose_free { &[][..] } else { &inputs[..] };
        let (mut predicted, took) = predictor.see(session, &choice.inputs(), known, choice.masks.as_ref())?;
        session.notes(&predicted.notes);
        if !pose_free {
            predicted.scale(false, choice.poses.points.as_deref())?;
        }
        let (first, keep) = (inputs[0].camera.pose, self.quality.kept());
        let mut scene = predicted.scene(&Pose::IDENTITY, keep)?;
        let to_cameras = if pose_free {
            aligned(&Capture { frames: predicted.frames()?, ..Capture::default() }, &inputs)?.0
        } else {
            Similarity { scale: 1.0, pose: Pose::IDENTITY }
        };
        place(&mut scene, &to_cameras, &first, capture);
        let [tokens, all] = predicted.patches();
        let (peak_bytes, stages) = (predicted.depths.peak_bytes, predicted.depths.times.clone());
        let network = Some(Network { tokens, all_tokens: all, peak_bytes, took, stages });
        Ok(Reconstruction { network, ..Reconstruction::given(scene) })
    }
}
