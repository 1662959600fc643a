//! Every combination of settings, measured.

use super::{
    Tradeoff,
    case::{self, Case},
    drawn::{compare, psnr_to_f64},
    point::Point,
    refined::refine,
    rounded::{OWN, Rounded},
    truth::{Compared, Errors, MOST_FLOPS, Truth},
};
use crate::{
    capture::Capture,
    commands::bench::Spread,
    metrics::psnr,
    options::Size,
    refinement::Steps,
    session::{Session, Stage},
};
use std::{collections::HashMap, ops::ControlFlow};
use zipsplat::{
    Error, Result,
    gpu::{Device, Progress, StageTimes},
    ops::{Arithmetic, Precision},
    reconstruct::{Kept, Model, Reconstruction, Selection, Shape},
    stages::{
        cluster::{even_indices, random_indices},
        render::Renderer,
    },
    types::{Image, Scene},
    weights::{Architecture, Checkpoint},
};

/// The results of a sweep.
#[derive(Default)]
pub struct Sweep {
    pub points: Vec<Point>,
    /// Time of each stage with every token, for each number of views.
    pub stages: Vec<(usize, StageTimes)>,
    /// The picture in place of the first photo, of each point.
    pub pictures: Vec<Image>,
    /// Pictures of `exact`, which those of others are compared with, by number of views, settings and Gaussians kept.
    drawn_exactly: HashMap<(usize, String, usize), Vec<f32>>,
}

/// The means of a sweep, and its results so far.
struct Bench<'a> {
    args: &'a Tradeoff,
    device: &'a Device,
    checkpoint: &'a Checkpoint,
    renderer: Renderer,
    truth: Truth<'a>,
    sweep: Sweep,
    /// The number of points of the whole sweep.
    points: usize,
}

/// The results of a reconstruction.
struct Forward {
    made: Reconstruction,
    scene: Scene,
    /// Median.
    ms: f64,
    views_per_cluster: Option<f64>,
    /// Absent where f64 would take too long.
    compared: Option<Compared>,
}

/// Whether every combination can be reconstructed, and so many Gaussians of a token kept; needs no device.
///
/// # Errors
/// That of the first that cannot.
pub fn check(args: &Tradeoff, architecture: &Architecture, Size(width, height): Size) -> Result<()> {
    let all = architecture.gaussians_per_token;
    if let Some(keep) = args.keep.iter().flatten().find(|keep| !(1..=all).contains(*keep)) {
        return Err(Error::argument("--keep", keep, format!("1 to {all}, the Gaussians of a token")));
    }
    for views in &args.views {
        for (ratio, selection) in args.ratio.iter().flat_map(|ratio| args.select.iter().map(move |s| (*ratio, s))) {
            let shape = Shape::new(architecture, *views, [width, height], (ratio, selection), true)?;
            args.pool.iter().try_for_each(|pool| shape.pooled(*pool).map(drop))?;
        }
    }
    Ok(())
}

/// Measures every combination, or as many as there is time for until the command should stop. In that case the other value is
/// the number of points of the whole sweep.
///
/// # Errors
/// Where a reconstruction or a picture fails; [`Error::Cancelled`] where there is no point yet.
pub fn run(
    args: &Tradeoff,
    session: &Session<'_>,
    device: &Device,
    (checkpoint, rounded): (&Checkpoint, &[Rounded]),
    arithmetics: &[(Precision, Arithmetic)],
    captures: &[Capture],
) -> Result<(Sweep, Option<usize>)> {
    let all = checkpoint.architecture().gaussians_per_token;
    let keep = args.keep.clone().unwrap_or_else(|| vec![all, all.div_ceil(2), all.div_ceil(4)]);
    let first = |checkpoint: &Checkpoint| {
        let suits = |(_, arithmetic): &&(Precision, Arithmetic)| checkpoint.suits(*arithmetic).is_ok();
        arithmetics.iter().find(suits).copied()
    };
    let own = arithmetics.iter().map(|arithmetic| (OWN, checkpoint, *arithmetic));
    let rounded = rounded.iter().filter_map(|r| Some((r.dtype, &r.checkpoint, first(&r.checkpoint)?)));
    let networks: Vec<_> = own.chain(rounded).collect();
    let mut bench = Bench {
        args,
        device,
        checkpoint,
        renderer: Renderer::new(device),
        truth: Truth::new(checkpoint),
        sweep: Sweep::default(),
        points: 0,
    };
    let stopped = session.stage("sweep", |stage| {
        for (i, (weights, checkpoint, (precision, arithmetic))) in networks.iter().enumerate() {
            stage.name("load weights");
            let model = Model::load_with(device, checkpoint, *arithmetic, |_| match stage.check() {
                Ok(()) => ControlFlow::Continue(()),
                Err(_) => ControlFlow::Break(()),
            })?;
            let mut cases = case::all(args, &model, (precision.name(), weights), &keep, captures)?;
            if i == 0 {
                let with_first = cases.iter().filter(|case| case.is_first(args)).count();
                let refinements: usize = cases.iter().map(|case| case.refine.len()).sum();
                let roundings = networks.len() - arithmetics.len();
                bench.points = cases.len() * keep.len() * arithmetics.len() + with_first * roundings + refinements;
            } else {
                cases.iter_mut().for_each(|case| case.refine.clear());
            }
            if *weights != OWN {
                cases.retain(|case| case.is_first(args));
                cases.iter_mut().for_each(|case| case.keep = &case.keep[..1]);
            }
            for case in &cases {
                stage.name(&format!("{}, {} views, {}", case.arithmetic(), case.capture.inputs.len(), case.settings));
                bench.measure(&model, case, stage)?;
            }
        }
        Ok(())
    });
    match stopped {
        Ok(_) => Ok((bench.sweep, None)),
        Err(Error::Cancelled) if !bench.sweep.points.is_empty() => Ok((bench.sweep, Some(bench.points))),
        Err(error) => Err(error),
    }
}

impl Bench<'_> {
    fn measure(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<()> {
        let forward = self.forward(model, case, stage)?;
        for keep in case.keep {
            stage.check()?;
            let found = self.point(model, case, &forward, *keep)?;
            self.add(found, stage);
        }
        for steps in &case.refine {
            stage.name(&format!("{} views, {}, {steps} steps", case.capture.inputs.len(), case.settings));
            let found = self.refined(model, case, &forward, *steps, stage)?;
            self.add(found, stage);
        }
        Ok(())
    }

    fn add(&mut self, (point, picture): (Point, Image), stage: &Stage<'_>) {
        self.sweep.points.push(point);
        self.sweep.pictures.push(picture);
        // Stopping is heard before the next: this one counts.
        let _ = stage.at(self.sweep.points.len() as f64 / self.points as f64);
    }

    /// Photos to Gaussians.
    fn forward(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<Forward> {
        let (images, capture, shape) = (case.capture.images(), case.capture, case.shape);
        let flops = model.plan(shape)?.plan.flops();
        let go_on = |_: Progress<'_>| stage.check().map_or(ControlFlow::Break(()), ControlFlow::Continue);
        let (mut times, mut last) = (Vec::new(), None);
        for i in 0..self.args.warmup + self.args.repeats {
            let made = last.insert(model.reconstruct(&images, &case.request, go_on)?);
            times.extend((i >= self.args.warmup).then(|| made.times.total()));
        }
        let made = last.expect("there is a repeat");
        if shape.kept == Kept::All && shape.pool == self.args.pool[0] && case.is_exact() {
            self.sweep.stages.push((capture.inputs.len(), made.times.clone()));
        }
        let (chosen, views_per_cluster) = chosen(model, case, &images)?;
        stage.check()?;
        let compared = match flops <= MOST_FLOPS {
            true => Some(self.truth.compare(model, capture, &case.request, &case.settings, chosen)?),
            false => None,
        };
        let scene = made.scene()?;
        Ok(Forward { made, scene, ms: Spread::of(times).median, views_per_cluster, compared })
    }

    /// The same with so many Gaussians kept of each token, and its picture.
    fn point(&mut self, model: &Model, case: &Case<'_>, forward: &Forward, keep: usize) -> Result<(Point, Image)> {
        let (capture, all) = (case.capture, model.architecture().gaussians_per_token);
        let mut scene = forward.scene.clone();
        if keep == all {
            self.renderer.show(&forward.made.gaussians)?;
        } else {
            scene.keep_most_visible(all, keep);
            self.renderer.load(&scene)?;
        }
        let drawn = compare(&mut self.renderer, capture)?;
        let against = |compared| psnr_to_f64(&mut self.renderer, compared, (all, keep), capture);
        let psnr_to_f64 = forward.compared.as_ref().map(against).transpose()?;
        let key = (capture.inputs.len(), case.settings.clone(), keep);
        let pixels = drawn.pictures.concat();
        let psnr_to_exact = self.sweep.drawn_exactly.get(&key).map(|exact| psnr(&pixels, exact));
        if case.is_exact() {
            self.sweep.drawn_exactly.insert(key, pixels);
        }
        let point = Point {
            keep,
            psnr_to_exact,
            psnr_to_f64,
            command: case.command(self.args, &format!("--keep {keep}")),
            ..drawn.point(self.settings(model, case, forward), &scene)?
        };
        Ok((point, drawn.picture(capture)?))
    }

    /// The same with all Gaussians, refined, and its picture.
    fn refined(
        &mut self,
        model: &Model,
        case: &Case<'_>,
        forward: &Forward,
        steps: Steps,
        stage: &Stage<'_>,
    ) -> Result<(Point, Image)> {
        let from = (case.capture, &case.request, &forward.scene);
        let refined = refine(self.device, (model, self.checkpoint), from, steps, stage)?;
        self.renderer.load(&refined.scene)?;
        let drawn = compare(&mut self.renderer, case.capture)?;
        let refine_ms = 1e3 * refined.took.as_secs_f64();
        let point = Point {
            refine: steps.to_string(),
            refine_ms,
            total_ms: forward.ms + refine_ms,
            peak_bytes: refined.peak_bytes.max(forward.made.peak_bytes),
            command: case.command(self.args, &format!("--refine {steps} --start scene")),
            ..drawn.point(self.settings(model, case, forward), &refined.scene)?
        };
        Ok((point, drawn.picture(case.capture)?))
    }

    /// A case's settings, with all Gaussians and without refinement, and what its forward pass gave.
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
            select: case.select.clone(),
            pool: shape.pool,
            keep: model.architecture().gaussians_per_token,
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

/// The tokens that a model chooses, and with k-means the mean over clusters of the number of views that their tokens come from.
fn chosen(model: &Model, case: &Case<'_>, images: &[Image]) -> Result<(Vec<u32>, Option<f64>)> {
    let (all, count) = (case.shape.grid.tokens(), case.shape.tokens);
    match (case.shape.kept, &case.request.selection) {
        (Kept::Kmeans(_), _) => clusters(model, case, images).map(|(nearest, views)| (nearest, Some(views))),
        (_, Selection::Given(indices)) => Ok((indices.clone(), None)),
        (Kept::Indices, Selection::Random(seed)) => Ok((random_indices(all, count, *seed), None)),
        (Kept::Indices, _) => Ok((even_indices(all, count), None)),
        (Kept::All, _) => Ok(((0..all as u32).collect(), None)),
    }
}

/// The tokens that k-means chooses and the mean number of views of a cluster. A run of its own: what is observed takes memory
/// and time that a reconstruction does not.
fn clusters(model: &Model, case: &Case<'_>, images: &[Image]) -> Result<(Vec<u32>, f64)> {
    let (plan, tensors) = model.record(case.shape, true)?;
    let mut run = model.run(plan)?;
    model.write_inputs(&mut run, &tensors, case.shape, images, &case.request)?;
    run.execute()?;
    let observed = |name: &str| -> Result<Vec<u32>> {
        let found = run.observed().iter().find(|(other, _)| other == name).map(|(_, tensor)| *tensor);
        run.read(found.expect("clustering observes it"))
    };
    let cluster_of_token = observed("assign")?;
    let mut seen: Vec<(u32, usize)> = cluster_of_token
        .iter()
        .enumerate()
        .map(|(token, cluster)| (*cluster, token / case.shape.grid.patches()))
        .collect();
    seen.sort_unstable();
    seen.dedup();
    let pairs = seen.len();
    seen.dedup_by_key(|(cluster, _)| *cluster);
    Ok((observed("nearest")?, pairs as f64 / seen.len().max(1) as f64))
}
