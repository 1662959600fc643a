use super::{
    Posed, Reconstruct,
    forward::{Forward, LOAD_WEIGHTS, rate},
};
use crate::{
    depth::{PredictedViews, PredictorOptions},
    options::{DEPTH_WEIGHTS, refuse_all},
    session::Session,
    table::counted,
    views::Crop,
};
use serde_json::json;
use zipsplat::{Result, weights::DepthCheckpoint};

impl Reconstruct {
    pub fn check_pixels(&self, checkpoint: &DepthCheckpoint) -> Result<()> {
        let tokens = self.refine.steps().is_some_and(|steps| steps.tokens);
        let options = [
            ("--crop tiles", self.crop.crop == Crop::Tiles),
            ("--block-size", self.blocks.block_size.is_some()),
            ("--block-overlap", self.blocks.block_overlap.is_some()),
            ("--scene-scale", self.scene_scale.is_some()),
            ("--explain", self.explain),
            ("--refine-target tokens", tokens),
        ];
        refuse_all(options, DEPTH_WEIGHTS, "weights of ZipSplat")?;
        self.quality.check_pixels(checkpoint)
    }

    pub fn predictor_options<'a>(&'a self, checkpoint: &'a DepthCheckpoint) -> PredictorOptions<'a> {
        let predictor_options = self.quality.predictor_options(checkpoint);
        let side = predictor_options.side.or(self.finding.search.matching_size);
        PredictorOptions { side, masks: self.finding.masks(), cameras: self.finding.cameras, ..predictor_options }
    }
}

impl Forward {
    /// Uses known cameras, or those that the network has `predicted`. World: the first camera.
    pub fn of_pixels(
        command: &Reconstruct,
        session: &mut Session<'_>,
        checkpoint: &DepthCheckpoint,
        predicted: Option<Box<PredictedViews>>,
        Posed { photos, poses, frames }: Posed<'_>,
    ) -> Result<Self> {
        let mut predicted = match predicted {
            Some(predicted) => *predicted,
            None => command.predictor_options(checkpoint).ask(session, photos, frames)?,
        };
        predicted.scale(false, poses.and_then(|poses| poses.points.as_deref()))?;
        let scene = predicted.scene(&frames[0].camera.pose, command.quality.kept())?;
        let [tokens, all] = predicted.patches();
        let PredictedViews { depths, network, precision, times, .. } = predicted;
        let views = depths.views.len();
        let loading = times.iter().find(|(step, _)| *step == LOAD_WEIGHTS).map(|(_, took)| *took);
        let rate = rate(checkpoint.bytes(), loading.unwrap_or_default());
        let json = vec![
            ("weights", json!(checkpoint.provenance())),
            ("network", json!(network)),
            ("views", json!(views)),
            ("width", json!(depths.width)),
            ("height", json!(depths.height)),
            ("tokens", json!(tokens)),
            ("all_tokens", json!(all)),
            ("weights_bytes_per_second", json!(rate)),
            ("precision", json!(precision.name())),
        ];
        let each = if checkpoint.architecture().gaussians { "by its head" } else { "round" };
        Ok(Self {
            scene,
            length: 1.0,
            times: times.into_iter().map(|(step, took)| (step.to_owned(), took)).collect(),
            peak_bytes: depths.peak_bytes,
            views_summary: format!(" from {} of {}x{}", counted(views, "view"), depths.width, depths.height),
            summary: format!(
                "{network}'s: a Gaussian, {each}, for each confident pixel of {tokens} of {all} patches, {} precision\n",
                precision.name()
            ),
            rate,
            json,
            ..Self::default()
        })
    }
}
