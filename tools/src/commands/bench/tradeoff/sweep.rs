//! Every combination of settings, measured.

use super::{
    Tradeoff,
    point::{Point, name},
    truth::{Compared, Errors, MOST_FLOPS, Truth},
};
use crate::{
    capture::{Capture, Score, draw},
    commands::bench::Spread,
    metrics::psnr,
    options::Size,
    session::{Session, Stage},
};
use std::{
    collections::HashMap,
    ops::ControlFlow,
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    gpu::{Device, StageTimes},
    ops::{Arithmetic, Precision},
    reconstruct::{Kept, Model, Ratio, Request, Selection, Shape},
    stages::{
        cluster::{even_indices, random_indices},
        render::Renderer,
    },
    types::{Image, Scene, write_ply},
    weights::{Architecture, Checkpoint},
};

/// The results of a sweep.
#[derive(Default)]
pub struct Sweep {
    pub points: Vec<Point>,
    /// Time of each stage with every token, for each number of views.
    pub stages: Vec<(usize, StageTimes)>,
    /// For the most views and all Gaussians: what each precision and ratio drew in place of the first photo.
    pub pictures: Vec<(String, Image)>,
    /// Pictures of `exact`, which those of others are compared with, by number of views, settings and Gaussians kept.
    drawn_exactly: HashMap<(usize, String, usize), Vec<f32>>,
}

/// A reconstruction that is to be measured.
struct Case<'a> {
    capture: &'a Capture,
    shape: Shape,
    request: Request,
    precision: &'a str,
    select: String,
    /// As the command line takes them.
    settings: String,
}

/// The means of a sweep, and its results so far.
struct Bench<'a> {
    args: &'a Tradeoff,
    /// Numbers of Gaussians of a token.
    keep: Vec<usize>,
    renderer: Renderer,
    truth: Truth<'a>,
    sweep: Sweep,
    /// The number of points of the whole sweep.
    points: usize,
}

/// The results of a reconstruction.
struct Forward {
    scene: Scene,
    /// Median.
    ms: f64,
    peak_bytes: u64,
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
            Shape::new(architecture, *views, [width, height], (ratio, selection), true)?;
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
    checkpoint: &Checkpoint,
    arithmetics: &[(Precision, Arithmetic)],
    captures: &[Capture],
) -> Result<(Sweep, Option<usize>)> {
    let all = checkpoint.architecture().gaussians_per_token;
    let mut bench = Bench {
        args,
        keep: args.keep.clone().unwrap_or_else(|| vec![all, all.div_ceil(2), all.div_ceil(4)]),
        renderer: Renderer::new(device),
        truth: Truth::new(checkpoint),
        sweep: Sweep::default(),
        points: 0,
    };
    let stopped = session.stage("sweep", |stage| {
        for (precision, arithmetic) in arithmetics {
            stage.name("load weights");
            let model = Model::load_with(device, checkpoint, *arithmetic, |_| match stage.check() {
                Ok(()) => ControlFlow::Continue(()),
                Err(_) => ControlFlow::Break(()),
            })?;
            let cases = cases(args, &model, precision.name(), captures)?;
            bench.points = cases.len() * bench.keep.len() * arithmetics.len();
            for case in &cases {
                stage.name(&format!("{}, {} views, {}", case.precision, case.capture.inputs.len(), case.settings));
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

/// The combinations, without those that differ only in what does not matter.
fn cases<'a>(args: &Tradeoff, model: &Model, precision: &'a str, captures: &'a [Capture]) -> Result<Vec<Case<'a>>> {
    let mut cases: Vec<Case<'a>> = Vec::new();
    for capture in captures {
        for &ratio in &args.ratio {
            for selection in &args.select {
                let request =
                    Request { ratio, selection: selection.clone(), cameras: Some(capture.cameras()), unit: 1.0 };
                let shape = model.shape(&capture.images(), &request)?;
                let whole = shape.kept == Kept::All;
                let same = |case: &Case| case.shape == shape && (whole || case.request.selection == *selection);
                if cases.iter().any(same) {
                    continue;
                }
                let select = if whole { "all".into() } else { name(selection) };
                let ratio = match ratio {
                    Ratio::Auto => "auto".into(),
                    Ratio::Fixed(ratio) => ratio.to_string(),
                };
                let settings =
                    if whole { format!("--ratio {ratio}") } else { format!("--ratio {ratio} --select {select}") };
                cases.push(Case { capture, shape, request, precision, select, settings });
            }
        }
    }
    Ok(cases)
}

impl Bench<'_> {
    fn measure(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<()> {
        let forward = self.forward(model, case, stage)?;
        for keep in self.keep.clone() {
            stage.check()?;
            let point = self.point(model, case, &forward, keep)?;
            self.sweep.points.push(point);
            // Stopping is heard before the next: this one counts.
            let _ = stage.at(self.sweep.points.len() as f64 / self.points as f64);
        }
        Ok(())
    }

    /// Photos to Gaussians.
    fn forward(&mut self, model: &Model, case: &Case<'_>, stage: &Stage<'_>) -> Result<Forward> {
        let (images, capture, shape) = (case.capture.images(), case.capture, case.shape);
        let (plan, tensors) = model.record(shape, false)?;
        let (peak_bytes, flops) = (model.plan(shape)?.bytes() + model.weight_bytes(), plan.flops());
        let mut run = model.run(plan)?;
        let (mut times, mut stages) = (Vec::new(), StageTimes::default());
        for i in 0..self.args.warmup + self.args.repeats {
            model.write_inputs(&mut run, &tensors, shape, &images, &case.request)?;
            let start = Instant::now();
            stages = run.execute_with(|_| stage.check().map_or(ControlFlow::Break(()), ControlFlow::Continue))?;
            if i >= self.args.warmup {
                times.push(start.elapsed());
            }
        }
        if shape.kept == Kept::All && case.precision == Precision::Exact.name() {
            self.sweep.stages.push((capture.inputs.len(), stages));
        }
        let (chosen, views_per_cluster) = chosen(model, case, &images)?;
        stage.check()?;
        let compared = match flops <= MOST_FLOPS {
            true => Some(self.truth.compare(model, capture, &case.request, &case.settings, chosen)?),
            false => None,
        };
        let scene = tensors.read(&run)?;
        Ok(Forward { scene, ms: Spread::of(times).median, peak_bytes, views_per_cluster, compared })
    }

    /// The same with so many Gaussians kept of each token.
    fn point(&mut self, model: &Model, case: &Case<'_>, forward: &Forward, keep: usize) -> Result<Point> {
        let (capture, shape, all) = (case.capture, case.shape, model.architecture().gaussians_per_token);
        let mut scene = forward.scene.clone();
        scene.keep_most_visible(all, keep);
        let drawn = compare(&mut self.renderer, &scene, capture)?;
        let against = |compared| psnr_to_f64(&mut self.renderer, compared, (all, keep), capture);
        let psnr_to_f64 = forward.compared.as_ref().map(against).transpose()?;
        let error = |of: fn(&Errors) -> f64| forward.compared.as_ref().map(|compared| of(&compared.errors));
        let key = (capture.inputs.len(), case.settings.clone(), keep);
        let pixels = drawn.pictures.concat();
        let psnr_to_exact = self.sweep.drawn_exactly.get(&key).map(|exact| psnr(&pixels, exact));
        if case.precision == Precision::Exact.name() {
            self.sweep.drawn_exactly.insert(key, pixels);
        }
        if keep == all
            && capture.inputs.len() == self.args.views.iter().copied().max().unwrap_or(0)
            && matches!(case.request.selection, Selection::KMEANS)
        {
            let Image { width, height, .. } = capture.targets[0].image;
            let label = format!("{}, r = {:.2}", case.precision, ratio(shape));
            self.sweep.pictures.push((label, Image::from_rgb_f32(width, height, &drawn.pictures[0])?));
        }
        Ok(Point {
            views: capture.inputs.len(),
            precision: case.precision.to_owned(),
            ratio: ratio(shape),
            select: case.select.clone(),
            keep,
            tokens: shape.tokens,
            gaussians: scene.len(),
            forward_ms: forward.ms,
            render_ms: Spread::of(drawn.times).median,
            peak_bytes: forward.peak_bytes,
            file_bytes: file_bytes(&scene)?,
            psnr: drawn.score.psnr,
            ssim: drawn.score.ssim,
            psnr_to_exact,
            psnr_to_f64,
            error_backbone: error(|errors| errors.backbone),
            error_fuse: error(|errors| errors.fuse),
            error_means: error(|errors| errors.means),
            error_scales: error(|errors| errors.scales),
            error_quats: error(|errors| errors.quats),
            error_opacities: error(|errors| errors.opacities),
            error_sh_coeffs: error(|errors| errors.sh_coeffs),
            views_per_cluster: forward.views_per_cluster,
            command: command(self.args, case, keep),
        })
    }
}

fn ratio(shape: Shape) -> f64 {
    shape.tokens as f64 / shape.grid.tokens() as f64
}

/// The pictures in place of the photos, and how long each took.
struct Drawn {
    pictures: Vec<Vec<f32>>,
    times: Vec<Duration>,
    score: Score,
}

fn compare(renderer: &mut Renderer, scene: &Scene, capture: &Capture) -> Result<Drawn> {
    renderer.load(scene)?;
    // The first picture of a scene also builds the plan.
    draw(renderer, &capture.targets[0].camera)?;
    let (mut pictures, mut times) = (Vec::new(), Vec::new());
    for view in &capture.targets {
        let start = Instant::now();
        pictures.push(draw(renderer, &view.camera)?);
        times.push(start.elapsed());
    }
    let score = Score::mean(&capture.scores(&pictures));
    Ok(Drawn { pictures, times, score })
}

/// Bytes of a scene as a PLY file.
fn file_bytes(scene: &Scene) -> Result<u64> {
    let folder = tempfile::tempdir().map_err(|error| zipsplat::Error::io("temporary folder", error))?;
    let path = folder.path().join("scene.ply");
    write_ply(scene, &path)?;
    Ok(path.metadata().map_err(|error| zipsplat::Error::io(&path, error))?.len())
}

/// PSNR of pictures of a reconstruction's Gaussians against those of f64, of which the same are kept.
fn psnr_to_f64(
    renderer: &mut Renderer,
    compared: &Compared,
    (group, keep): (usize, usize),
    capture: &Capture,
) -> Result<f64> {
    let kept = compared.scene.most_visible(group, keep);
    let mut draw = |scene: &Scene| -> Result<Vec<f32>> {
        let mut scene = scene.clone();
        scene.keep(&kept);
        renderer.load(&scene)?;
        Ok(capture.targets.iter().map(|view| draw(renderer, &view.camera)).collect::<Result<Vec<_>>>()?.concat())
    };
    Ok(psnr(&draw(&compared.scene)?, &draw(&compared.truth)?))
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

fn command(args: &Tradeoff, case: &Case<'_>, keep: usize) -> String {
    let folder = args.folder.to_string_lossy();
    let mut options = format!("--views {} {}", case.capture.inputs.len(), case.settings);
    options += &format!(" --keep {keep} --precision {} --targets {}", case.precision, args.targets);
    if let Some(size) = args.size {
        options += &format!(" --size {size}");
    }
    if let Some(unit) = args.unit {
        options += &format!(" --unit {unit}");
    }
    let words = ["zipsplat", "eval", &folder].into_iter().chain(options.split(' ')).chain(args.weights.as_arguments());
    shlex::try_join(words).expect("no argument of a command holds a NUL")
}
