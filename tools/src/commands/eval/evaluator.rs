use super::{
    Eval, Scaling,
    alignment::Alignment,
    external_scene::depth_scene,
    reconstruction::{Network, Reconstruction},
};
use crate::{
    capture::{Choice, Posed, Score, ViewSplit, draw},
    depth::{DepthPredictor, PredictorOptions},
    options::{Network as Weighed, Quality, refuse},
    refinement::{self, Initialization, Refinable, RefineTask},
    released::open_depth,
    session::Session,
    views::Seeing,
};
use std::path::Path;
use zipsplat::{
    Error, Result,
    gpu::{Arena, Device},
    ops::{Arithmetic, Precision},
    perceptual::Perceptual,
    reconstruct::Model,
    refine::{FrozenHead, RefineLength, RefineResult, StopReason},
    stages::render::Renderer,
    weights::{Checkpoint, DepthHeads},
};

/// Gain in dB that ends --converge.
const CONVERGED: f64 = 0.1;

pub struct Evaluator<'a> {
    pub(super) eval: &'a Eval,
    weights: &'a Weighed,
    seeing: Seeing,
    pub(super) device: Device,
    pub precision: Precision,
    arithmetic: Arithmetic,
    model: Option<Model>,
    pub(super) predictor: Option<DepthPredictor>,
    scaler: Option<DepthPredictor>,
    pub quality: Quality,
    renderer: Renderer,
    lpips: Option<Perceptual>,
}

pub struct Evaluation {
    pub capture: ViewSplit,
    pub reconstruction: Reconstruction,
    /// Targets, `[height][width][rgb]` in 0..1.
    pub drawn: Vec<Vec<f32>>,
    pub scores: Vec<Score>,
    pub alignment: Option<Alignment>,
}

impl<'a> Evaluator<'a> {
    pub fn new(eval: &'a Eval, weights: &'a Weighed, seeing: Seeing, session: &mut Session<'_>) -> Result<Self> {
        let device = session.device()?;
        let gradients = eval.aligning().is_some_and(|method| method == crate::align::Method::Adam);
        let lpips = eval.lpips.open(&device, gradients, eval.series.protocol.is_some())?;
        let (precision, arithmetic) = eval.quality.arithmetic.choose(session, &device)?;
        let renderer = Renderer::new(&device);
        let (model, predictor, scaler, quality) = (None, None, None, eval.quality.clone());
        Ok(Self {
            eval,
            weights,
            seeing,
            device,
            precision,
            arithmetic,
            model,
            predictor,
            scaler,
            quality,
            renderer,
            lpips,
        })
    }

    pub fn evaluate(&mut self, session: &mut Session<'_>, choice: &Choice, name: Option<&str>) -> Result<Evaluation> {
        let (eval, seeing) = (self.eval, self.seeing);
        let by_depth = if let Some(Scaling::Depth(from)) = &eval.scene_scale { Some(from) } else { None };
        let length = by_depth.map_or(eval.length(), |_| Some(1.0));
        let (mut capture, _) = session.stage("load photos", |stage| choice.load(seeing, length, stage))?;
        if let Some(from) = by_depth {
            self.scale_by_depth(session, choice, &mut capture, from)?;
        }
        capture.notes().for_each(|note| session.note(note));
        let reconstruction = match (eval.external.make(session, name, choice, &capture)?, self.weights) {
            (None, Weighed::Tokens(checkpoint)) => self.reconstruct(session, choice, &capture, checkpoint)?,
            (None, Weighed::Pixels(checkpoint)) => {
                let reconstruction = self.of_pixels(session, choice, &capture, checkpoint)?;
                self.refined(session, choice, &capture, reconstruction)?
            }
            (Some(reconstruction), _) => self.refined(session, choice, &capture, reconstruction)?,
        };
        let (drawn, mut alignment) = self.draw(session, &capture)?;
        let mut scores = capture.scores(&drawn);
        if reconstruction.refined.as_ref().is_some_and(|refined| refined.exposures.is_some()) {
            capture.score_colors(&mut scores, &drawn);
        }
        if let Some(lpips) = &mut self.lpips {
            session.stage("compare", |_| capture.score_lpips(&mut scores, &drawn, lpips))?;
            let rows = alignment.iter_mut().flat_map(|alignment| &mut alignment.rows);
            rows.zip(&scores).for_each(|(row, score)| row.lpips = score.lpips);
        }
        Ok(Evaluation { capture, reconstruction, drawn, scores, alignment })
    }

    fn scale_by_depth(
        &mut self,
        session: &mut Session<'_>,
        choice: &Choice,
        capture: &mut ViewSplit,
        from: &str,
    ) -> Result<()> {
        let scene = if Path::new(from).is_dir() {
            depth_scene(Path::new(from), choice, capture)?
        } else {
            let predictor = match self.scaler.take() {
                Some(predictor) => predictor,
                None => {
                    let checkpoint = open_depth(from, DepthHeads::default())?;
                    let options = PredictorOptions::of(&checkpoint, &self.quality.arithmetic);
                    PredictorOptions { side: self.quality.side(), ..options }.open(session, &self.device)?
                }
            };
            let (predictor, frames) = (self.scaler.insert(predictor), choice.input_frames());
            let (mut predicted, _) = predictor.see(session, &choice.inputs(), &frames, choice.masks.as_ref())?;
            predicted.scale(false, choice.poses.points.as_deref())?;
            predicted.scene(&frames[0].camera.pose, None)?
        };
        capture.rescale_to(&scene, from.to_owned())
    }

    fn refined(
        &mut self,
        session: &mut Session<'_>,
        choice: &Choice,
        capture: &ViewSplit,
        mut reconstruction: Reconstruction,
    ) -> Result<Reconstruction> {
        let eval = self.eval;
        if let Some(steps) = eval.refine.steps() {
            refuse("--refine-target tokens", steps.tokens, "a scene of given depth", "a network's scene")?;
            let cloud = choice.points(&capture.scene_scale)?;
            let init = eval.refine.settings.init.unwrap_or(Initialization::Scene);
            reconstruction.started = init.name();
            let (photos, cameras) = capture.training_views();
            let given = Some(reconstruction.scene);
            let (scene, _) = refinement::initial(
                session,
                init,
                given,
                cloud.as_ref(),
                &photos,
                &cameras,
                eval.refine.settings.max_gaussians,
            )?;
            let arena = Arena::new(&self.device);
            let refined = refine(eval, session, &arena, Refinable::Scene(&scene), choice, capture, steps)?;
            (reconstruction.scene, reconstruction.refined) = (refined.scene.clone(), Some(refined));
        }
        self.renderer.set_scene(&reconstruction.scene)?;
        Ok(reconstruction)
    }

    fn reconstruct(
        &mut self,
        session: &mut Session<'_>,
        choice: &Choice,
        capture: &ViewSplit,
        checkpoint: &Checkpoint,
    ) -> Result<Reconstruction> {
        let (eval, quality) = (self.eval, &self.quality);
        if self.model.is_none() {
            self.model = Some(session.load_model(&self.device, checkpoint, self.arithmetic)?.0);
        }
        let model = self.model.as_ref().expect("it was loaded");
        let images = &capture.views.images;
        let (cameras, world) = self.seeing.crop.network_cameras(capture.views.cameras.clone());
        let mut request = quality.request(if eval.pose_free { Vec::new() } else { cameras }, 1.0);
        let blocks = eval.blocks.choose(model, images.len(), self.seeing.size, &mut request, |_, _| Ok(1.0))?;
        let of_tokens = eval.refine.steps().is_some_and(|steps| steps.tokens);
        let ((result, tokens), took) = session.reconstruct(model, images, &blocks, &request, of_tokens)?;
        let mut scene = result.to_scene()?;
        quality.prune(&mut scene, checkpoint.architecture());
        world.iter().for_each(|world| scene.place(1.0, world));
        let mut started = refinement::TOKENS;
        let refined = match (eval.refine.steps(), &tokens) {
            (Some(steps), Some(tokens)) => {
                let head = FrozenHead::load(&self.device, checkpoint)?;
                Some(refine(eval, session, model.arena(), Refinable::Tokens(&head, tokens), choice, capture, steps)?)
            }
            (Some(steps), None) => {
                let cloud = choice.points(&capture.scene_scale)?;
                let init =
                    Initialization::or_best(eval.refine.settings.init, cloud.as_ref(), eval.weights.is_builtin());
                started = init.name();
                let (photos, cameras) = capture.training_views();
                let (initial, _) = refinement::initial(
                    session,
                    init,
                    Some(scene.clone()),
                    cloud.as_ref(),
                    &photos,
                    &cameras,
                    eval.refine.settings.max_gaussians,
                )?;
                Some(refine(eval, session, model.arena(), Refinable::Scene(&initial), choice, capture, steps)?)
            }
            (None, _) => None,
        };
        if let Some(refined) = &refined {
            scene = refined.scene.clone();
        }
        match &world {
            // Unchanged on the host.
            None if refined.is_none() && scene.len() == result.gaussians.len() => {
                self.renderer.set_scene(&result.gaussians)?;
            }
            _ => self.renderer.set_scene(&scene)?,
        }
        let all_tokens = images.len() * self.seeing.size.patches(model.architecture().patch_size);
        let (tokens, peak_bytes, stages) = (result.tokens, result.peak_bytes, result.times.clone());
        let network = Some(Network { tokens, all_tokens, peak_bytes, took, stages });
        Ok(Reconstruction { scene, network, refined, started })
    }

    fn draw(&mut self, session: &Session<'_>, capture: &ViewSplit) -> Result<(Vec<Vec<f32>>, Option<Alignment>)> {
        let arena = self.model.as_ref().map_or_else(|| Arena::new(&self.device), |model| model.arena().clone());
        let Self { renderer, lpips, .. } = self;
        let targets = &capture.targets;
        let Some(method) = self.eval.aligning() else {
            let picture = |view: &Posed| draw(renderer, &view.camera);
            return Ok((session.stage("compare", |stage| stage.each(targets, picture))?.0, None));
        };
        let photos: Vec<_> = targets.iter().map(|view| (&view.image, &view.camera)).collect();
        let (found, _) = session.stage("align", |stage| {
            method.align(renderer, &photos, lpips.as_mut(), &arena, &|part| stage.reach(part))
        })?;
        let alignment = Alignment::new(capture, &found);
        Ok((found.into_iter().map(|found| found.drawn).collect(), Some(alignment)))
    }
}

fn refine(
    eval: &Eval,
    session: &mut Session<'_>,
    arena: &Arena,
    from: Refinable<'_>,
    choice: &Choice,
    capture: &ViewSplit,
    steps: RefineTask,
) -> Result<RefineResult> {
    let (photos, cameras) = capture.training_views();
    let (settings, files, frames) = (&eval.refine.settings, choice.inputs(), choice.input_frames());
    let known = settings.known_depth(session, &files, &frames, &cameras, capture.scene_scale.length)?;
    let kind = known.as_ref().map(|known| known.kind);
    let mut request = settings.request(steps, eval.external.input.antialiasing, kind, &files);
    if eval.series.protocol.is_some() && steps.tokens {
        // As in the paper's tables.
        request.holdout_views = request.holdout_views.or(Some(0));
    }
    let mut best: Option<RefineResult> = None;
    loop {
        let refined = refinement::refine(session, arena, from, &photos, known.as_ref(), &cameras, &request)?;
        let gain = best.as_ref().map_or(f64::INFINITY, |best| refined.training_psnr[0] - best.training_psnr[0]);
        match (&refined.stop_reason, &mut request.length) {
            (Some(StopReason::Cancelled), _) => return Err(Error::Cancelled),
            (None, RefineLength::Steps(steps)) if eval.converge && gain >= CONVERGED => *steps *= 2,
            _ => return Ok(if gain < 0.0 { best.unwrap_or(refined) } else { refined }),
        }
        best = Some(refined);
    }
}
