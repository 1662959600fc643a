use super::{
    Minutes, Tradeoff,
    case::{self, Case},
    drawn::{compare, psnr_to_f64},
    point::Point,
    rounded::{OWN, Rounded},
    truth::{Compared, Errors, MOST_FLOPS, Truth, observe},
};
use crate::{
    capture::ViewSplit,
    commands::bench::Spread,
    metrics::psnr,
    options::Size,
    refinement::{Initialization, RefineTask},
    session::{Session, Stage},
};
use clap::ValueEnum;
use indicatif::HumanDuration;
use std::{collections::HashMap, ops::ControlFlow, time::Instant};
use zipsplat::{
    Error, Result,
    gpu::{Device, StageTimes},
    ops::{Arithmetic, Precision},
    reconstruct::{Model, Reconstruction, Shape, TokenSampling},
    refine::{FrozenHead, RefineOptions, RefineResult, StopReason, refine_scene, refine_tokens},
    stages::render::Renderer,
    types::{Image, PointCloud, Scene},
    weights::{Architecture, Checkpoint},
};

pub struct Networks<'a> {
    pub checkpoint: &'a Checkpoint,
    pub rounded: &'a [Rounded],
    pub arithmetics: &'a [(Precision, Arithmetic)],
}

#[derive(Default)]
pub struct Sweep {
    pub points: Vec<Point>,
    /// With every token, by number of views.
    pub stages: Vec<(usize, StageTimes)>,
    pub pictures: Vec<Image>,
    pub planned: usize,
    /// By number of views, settings and Gaussians kept.
    drawn_exactly: HashMap<(usize, String, usize), Vec<f32>>,
}

struct Bench<'a> {
    args: &'a Tradeoff,
    device: &'a Device,
    checkpoint: &'a Checkpoint,
    renderer: Renderer,
    truth: Truth<'a>,
    sweep: Sweep,
    began: Instant,
}

struct Forward {
    made: Reconstruction,
    scene: Scene,
    /// Median.
    ms: f64,
    views_per_cluster: Option<f64>,
    compared: Option<Compared>,
}

pub fn check(args: &Tradeoff, architecture: &Architecture, Size(width, height): Size) -> Result<()> {
    let all = architecture.gaussians_per_token;
    args.max_gaussians_per_token.iter().flatten().try_for_each(|keep| keep.of(all).map(drop))?;
    for views in &args.views {
        for (ratio, selection) in
            args.ratio.iter().flat_map(|ratio| args.token_selection.iter().map(move |s| (*ratio, s)))
        {
            Shape::new(architecture, *views, [width, height], ratio, selection, true)?;
        }
    }
    Ok(())
}

/// Also returns the error that ended the sweep after its first point.
pub fn run(
    args: &Tradeoff,
    session: &mut Session<'_>,
    device: &Device,
    Networks { checkpoint, rounded, arithmetics }: Networks<'_>,
    captures: &[ViewSplit],
    clouds: &[Option<PointCloud>],
) -> Result<(Sweep, Option<Error>)> {
    let all = checkpoint.architecture().gaussians_per_token;
    let keep = match &args.max_gaussians_per_token {
        Some(keep) => keep.iter().map(|keep| keep.of(all)).collect::<Result<_>>()?,
        None => vec![all, all.div_ceil(2), all.div_ceil(4)],
    };
    let first = |checkpoint: &Checkpoint| {
        let suits = |(_, arithmetic): &&(Precision, Arithmetic)| checkpoint.suits(*arithmetic).is_ok();
        arithmetics.iter().find(suits).copied()
    };
    let own = arithmetics.iter().map(|arithmetic| (OWN, checkpoint, *arithmetic));
    let rounded = rounded.iter().filter_map(|r| Some((r.dtype, &r.checkpoint, first(&r.checkpoint)?)));
    let networks: Vec<Network<'_>> = own.chain(rounded).collect();
    let architecture = checkpoint.architecture();
    let cases = case::all(args, architecture, arithmetics[0].0.name(), &keep, captures, clouds)?;
    let passes = passes(args, &networks, &cases);
    let points = |case: &Case<'_>| case.keep.len() + case.refine.len();
    let planned = passes.iter().flat_map(|(_, cases)| cases).map(points).sum();
    if let Minutes(Some(time)) = args.minutes {
        let time = HumanDuration(time);
        session.note(format!("{planned} points, the most informative first, for at most {time} (--minutes)"));
    }
    let mut bench = Bench {
        args,
        device,
        checkpoint,
        renderer: Renderer::new(device),
        truth: Truth::new(checkpoint),
        sweep: Sweep { planned, ..Sweep::default() },
        began: Instant::now(),
    };
    match session.stage("sweep", |stage| bench.run(&networks, &passes, stage)) {
        Err(error) if bench.sweep.points.is_empty() => Err(error),
        ended => Ok((bench.sweep, ended.err())),
    }
}

type Network<'a> = (&'a str, &'a Checkpoint, (Precision, Arithmetic));

/// First choices with every network, then the others.
fn passes<'a>(args: &Tradeoff, networks: &[Network<'a>], cases: &[Case<'a>]) -> Vec<(usize, Vec<Case<'a>>)> {
    let mut passes = Vec::new();
    for begins in [true, false] {
        for (i, (weights, _, (precision, _))) in networks.iter().enumerate() {
            let is_rounded = *weights != OWN;
            let mut chosen: Vec<Case<'a>> =
                cases.iter().filter(|case| case.is_first(args) == begins && (begins || !is_rounded)).cloned().collect();
            for case in &mut chosen {
                (case.precision, case.weights) = (precision.name(), weights);
                if i > 0 {
                    case.refine.clear();
                }
                if is_rounded {
                    case.keep = &case.keep[..1];
                }
            }
            passes.push((i, chosen));
        }
    }
    passes.retain(|(_, cases)| !cases.is_empty());
    passes
}

impl Bench<'_> {
    fn run(&mut self, networks: &[Network<'_>], passes: &[(usize, Vec<Case<'_>>)], stage: &Stage<'_>) -> Result<()> {
        for (i, cases) in passes {
            stage.name("load weights");
            let (_, checkpoint, (_, arithmetic)) = networks[*i];
            let model = Model::from_checkpoint_with(self.device, checkpoint, arithmetic, |_| stage.go_on())?;
            for case in cases {
                stage.name(&format!("{}, {} views, {}", case.arithmetic(), case.capture.inputs.len(), case.settings));
                if self.measure(&model, case, stage)?.is_break() {
                    return Ok(());
                }
            }
        }
        Ok(())
    }

    fn spent(&self) -> f64 {
        self.args.minutes.0.map_or(0.0, |time| self.began.elapsed().div_duration_f64(time))
    }

    fn measure(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<ControlFlow<()>> {
        let forward = self.forward(model, case, stage)?;
        for keep in case.keep {
            stage.check()?;
            let (point, picture) = self.point(model, case, &forward, *keep)?;
            if self.add(point, picture, stage).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        for (init, steps) in &case.refine {
            stage.name(&format!("{} views, {}, {steps} steps", case.capture.inputs.len(), case.settings));
            let (point, picture) = self.refined(model, case, &forward, *init, *steps, stage)?;
            if self.add(point, picture, stage).is_break() {
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    fn add(&mut self, point: Point, picture: Image, stage: &Stage<'_>) -> ControlFlow<()> {
        self.sweep.points.push(point);
        self.sweep.pictures.push(picture);
        let spent = self.spent();
        let _ = stage.at(spent.max(self.sweep.points.len() as f64 / self.sweep.planned as f64).min(1.0));
        if spent < 1.0 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    }

    fn forward(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<Forward> {
        let (images, capture, shape) = (&case.capture.views.images, case.capture, case.shape);
        let flops = model.plan(shape)?.plan.flops();
        let (mut times, mut last) = (Vec::new(), None);
        for i in 0..self.args.warmup + self.args.repeats {
            let made = last.insert(model.reconstruct_views(images, &case.request, |_| stage.go_on())?);
            times.extend((i >= self.args.warmup).then(|| made.times.total()));
        }
        let made = last.expect("there is a repeat");
        if shape.kept == TokenSampling::All && case.request.kv_pool == self.args.kv_pool[0] && case.is_exact() {
            self.sweep.stages.push((capture.inputs.len(), made.times.clone()));
        }
        let (chosen, views_per_cluster) = chosen(model, case, images)?;
        stage.check()?;
        let compared = if flops <= MOST_FLOPS {
            Some(self.truth.compare(model, capture, &case.request, &case.settings, chosen)?)
        } else {
            None
        };
        let scene = made.to_scene()?;
        Ok(Forward { made, scene, ms: Spread::of(times).median, views_per_cluster, compared })
    }

    fn point(&mut self, model: &Model, case: &Case<'_>, forward: &Forward, keep: usize) -> Result<(Point, Image)> {
        let (capture, all) = (case.capture, model.architecture().gaussians_per_token);
        let mut scene = forward.scene.clone();
        if keep == all {
            self.renderer.set_scene(&forward.made.gaussians)?;
        } else {
            scene.keep_most_visible(all, keep);
            self.renderer.set_scene(&scene)?;
        }
        let drawn = compare(&mut self.renderer, capture)?;
        let against = |compared| psnr_to_f64(&mut self.renderer, compared, all, keep, capture);
        let psnr_to_f64 = forward.compared.as_ref().map(against).transpose()?;
        let key = (capture.inputs.len(), case.settings.clone(), keep);
        let pixels = drawn.pictures.concat();
        let psnr_to_fp32 = self.sweep.drawn_exactly.get(&key).map(|exact| psnr(&pixels, exact));
        if case.is_exact() {
            self.sweep.drawn_exactly.insert(key, pixels);
        }
        let point = Point {
            max_gaussians_per_token: keep,
            psnr_to_fp32,
            psnr_to_f64,
            command: case.command(self.args, &format!("{} --max-gaussians-per-token {keep}", case.settings)),
            ..drawn.point(self.settings(model, case, forward), &scene)?
        };
        Ok((point, drawn.picture(capture)?))
    }

    fn refined(
        &mut self,
        model: &Model,
        case: &Case<'_>,
        forward: &Forward,
        init: Initialization,
        steps: RefineTask,
        stage: &Stage<'_>,
    ) -> Result<(Point, Image)> {
        let begin = Instant::now();
        let (photos, cameras) = case.capture.training_views();
        let scene = init.scene(Some(forward.scene.clone()), case.cloud, &photos, &cameras, None, |_| stage.at(0.0))?;
        let stereo_ms = 1e3 * begin.elapsed().as_secs_f64();
        let refined = self.refine(model, case, &scene, steps, stage)?;
        self.renderer.set_scene(&refined.scene)?;
        let drawn = compare(&mut self.renderer, case.capture)?;
        let refine_ms = stereo_ms + 1e3 * refined.took.as_secs_f64();
        let settings = match init {
            Initialization::Points => Point::of_points(case.capture.inputs.len(), case.precision),
            _ => self.settings(model, case, forward),
        };
        let name = init.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
        let options = if init == Initialization::Points { String::new() } else { format!("{} ", case.settings) };
        let point = Point {
            max_gaussians_per_token: model.architecture().gaussians_per_token,
            refine: steps.to_string(),
            refine_ms,
            total_ms: settings.forward_ms + refine_ms,
            peak_bytes: refined.peak_bytes.max(settings.peak_bytes),
            command: case.command(self.args, &format!("{options}--refine {steps} --init {name}")),
            init: name,
            ..drawn.point(settings, &refined.scene)?
        };
        Ok((point, drawn.picture(case.capture)?))
    }

    fn refine(
        &self,
        model: &Model,
        case: &Case<'_>,
        scene: &Scene,
        steps: RefineTask,
        stage: &Stage<'_>,
    ) -> Result<RefineResult> {
        let (photos, cameras) = case.capture.training_views();
        let (arena, request) = (model.arena(), &case.request);
        let options = RefineOptions { length: steps.length, ..RefineOptions::default() };
        let refined = if steps.tokens {
            let features = model.features(&case.capture.views.images, request, |_| stage.go_on())?;
            let tokens = model.tokens(&features, request, |_| stage.go_on())?;
            drop(features);
            let head = FrozenHead::load(arena.device(), self.checkpoint)?;
            refine_tokens(arena, &head, &tokens, &photos, &cameras, &options, |_| stage.go_on())?
        } else {
            refine_scene(arena, scene, &photos, &cameras, &options, |_| stage.go_on())?
        };
        match refined.stop_reason {
            Some(StopReason::Cancelled) => Err(Error::Cancelled),
            _ => Ok(refined),
        }
    }

    fn settings(&self, model: &Model, case: &Case<'_>, forward: &Forward) -> Point {
        let shape = case.shape;
        let error = |of: fn(&Errors) -> f64| forward.compared.as_ref().map(|compared| of(&compared.errors));
        Point {
            views: case.capture.inputs.len(),
            precision: case.precision.to_owned(),
            weights: case.weights.to_owned(),
            weight_bytes: model.weight_bytes(),
            ratio: shape.tokens as f64 / shape.grid.tokens() as f64,
            asked_ratio: case.ratio.clone(),
            token_selection: case.select.clone(),
            kv_pool: case.request.kv_pool.to_string(),
            max_gaussians_per_token: model.architecture().gaussians_per_token,
            refine: "0".into(),
            tokens: shape.tokens,
            forward_ms: forward.ms,
            total_ms: forward.ms,
            peak_bytes: forward.made.peak_bytes,
            error_backbone: error(|errors| errors.backbone),
            error_fuse: error(|errors| errors.fuse),
            error_means: error(|errors| errors.means),
            error_scales: error(|errors| errors.scales),
            error_quats: error(|errors| errors.quats),
            error_opacities: error(|errors| errors.opacities),
            error_sh_coeffs: error(|errors| errors.sh_coeffs),
            views_per_cluster: forward.views_per_cluster,
            ..Point::default()
        }
    }
}

/// Returns the kept tokens and, for k-means, the mean number of views per cluster.
fn chosen(model: &Model, case: &Case<'_>, images: &[Image]) -> Result<(Vec<u32>, Option<f64>)> {
    let (all, count) = (case.shape.grid.tokens(), case.shape.tokens);
    match case.shape.kept {
        TokenSampling::All => return Ok(((0..all as u32).collect(), None)),
        TokenSampling::Indices => return Ok((case.request.token_selection.indices(all, count), None)),
        TokenSampling::Kmeans(_) | TokenSampling::MutualNearest => {}
    }
    // Observation would distort time and memory.
    let (run, _) = observe(model, images, &case.request)?;
    let observed = |name: &str| -> Result<Option<Vec<u32>>> {
        let found = run.observed().iter().find(|(other, _)| other == name);
        found.map(|(_, tensor)| run.read(*tensor)).transpose()
    };
    let views_per_cluster = |cluster_of_token: Vec<u32>| {
        let view = |token| token / case.shape.grid.patches();
        let pairs = cluster_of_token.iter().enumerate().map(|(token, cluster)| (*cluster, view(token)));
        let mut seen: Vec<(u32, usize)> = pairs.collect();
        seen.sort_unstable();
        seen.dedup();
        let pairs = seen.len();
        seen.dedup_by_key(|(cluster, _)| *cluster);
        pairs as f64 / seen.len().max(1) as f64
    };
    let nearest = observed("nearest")?.expect("the selection observes it");
    Ok((nearest, observed("assign")?.map(views_per_cluster)))
}
