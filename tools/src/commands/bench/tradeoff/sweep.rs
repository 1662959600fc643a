//! Every combination of settings, measured.

use super::{
    Tradeoff,
    point::{Point, name},
};
use crate::{
    capture::{Capture, Score},
    commands::bench::Spread,
    metrics::psnr,
    options::Size,
    session::Session,
};
use std::{
    collections::HashMap,
    time::{Duration, Instant},
};
use zipsplat::{
    Result,
    gpu::{Device, StageTimes},
    ops::{Arithmetic, Precision},
    reconstruct::{Kept, Model, Ratio, Request, Selection, Shape},
    stages::render::Renderer,
    types::{Image, Scene, write_ply},
    weights::{Architecture, Checkpoint},
};

/// What a sweep gave.
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

/// Whether every combination can be reconstructed; needs no device.
///
/// # Errors
/// That of the first that cannot.
pub fn check(args: &Tradeoff, architecture: &Architecture, Size(width, height): Size) -> Result<()> {
    for views in &args.views {
        for (ratio, selection) in args.ratio.iter().flat_map(|ratio| args.select.iter().map(move |s| (*ratio, s))) {
            Shape::new(architecture, *views, [width, height], (ratio, selection), true)?;
        }
    }
    Ok(())
}

/// Measures every combination.
///
/// # Errors
/// Where a reconstruction or a picture fails.
pub fn run(
    args: &Tradeoff,
    session: &Session<'_>,
    device: &Device,
    checkpoint: &Checkpoint,
    arithmetics: &[(Precision, Arithmetic)],
    captures: &[Capture],
) -> Result<Sweep> {
    let mut sweep = Sweep::default();
    let mut renderer = Renderer::new(device);
    let all = checkpoint.architecture().gaussians_per_token;
    let keep = args.keep.clone().unwrap_or_else(|| vec![all, all.div_ceil(2), all.div_ceil(4)]);
    for (precision, arithmetic) in arithmetics {
        let (model, _) = session.load_model(device, checkpoint, *arithmetic)?;
        let cases = cases(args, &model, precision.name(), captures)?;
        for case in &cases {
            let label = format!("{}, {} views, {}", case.precision, case.capture.inputs.len(), case.settings);
            session.stage(&label, |stage| {
                let points = cases.len() * keep.len() * arithmetics.len();
                stage.reach(sweep.points.len() as f64 / points as f64)?;
                measure(args, &model, &mut renderer, case, &keep, &mut sweep)
            })?;
        }
    }
    Ok(sweep)
}

/// The combinations, without those that differ only in what does not matter.
fn cases<'a>(args: &Tradeoff, model: &Model, precision: &'a str, captures: &'a [Capture]) -> Result<Vec<Case<'a>>> {
    let mut cases: Vec<Case<'a>> = Vec::new();
    for capture in captures {
        for &ratio in &args.ratio {
            for selection in &args.select {
                let request = Request { ratio, selection: selection.clone(), cameras: Some(capture.cameras()) };
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

fn measure(
    args: &Tradeoff,
    model: &Model,
    renderer: &mut Renderer,
    case: &Case<'_>,
    keep: &[usize],
    sweep: &mut Sweep,
) -> Result<()> {
    let (images, capture, shape) = (case.capture.images(), case.capture, case.shape);
    let (plan, tensors) = model.record(shape, false)?;
    let peak_bytes = plan.arena_bytes() + model.weight_bytes();
    let mut run = model.run(plan)?;
    let mut times = Vec::new();
    let mut stages = StageTimes::default();
    for i in 0..args.warmup + args.repeats {
        model.write_inputs(&mut run, &tensors, shape, &images, &case.request)?;
        let start = Instant::now();
        stages = run.execute_with(|_| std::ops::ControlFlow::Continue(()))?;
        if i >= args.warmup {
            times.push(start.elapsed());
        }
    }
    if shape.kept == Kept::All && case.precision == "exact" {
        sweep.stages.push((capture.inputs.len(), stages));
    }
    let views_per_cluster = views_per_cluster(model, case, &images)?;
    let whole = tensors.read(&run, model.architecture().sh_degree as u32)?;
    for &keep in keep.iter().filter(|keep| **keep <= model.architecture().gaussians_per_token) {
        let mut scene = whole.clone();
        scene.keep_most_visible(model.architecture().gaussians_per_token, keep);
        let drawn = compare(renderer, &scene, capture)?;
        let key = (capture.inputs.len(), case.settings.clone(), keep);
        let pixels = drawn.pictures.concat();
        let psnr_to_exact = sweep.drawn_exactly.get(&key).map(|exact| psnr(&pixels, exact));
        if case.precision == Precision::Exact.name() {
            sweep.drawn_exactly.insert(key, pixels);
        }
        if keep == model.architecture().gaussians_per_token
            && capture.inputs.len() == args.views.iter().copied().max().unwrap_or(0)
            && matches!(case.request.selection, Selection::KMEANS)
        {
            let Image { width, height, .. } = capture.targets[0].image;
            let label = format!("{}, r = {:.2}", case.precision, ratio(shape));
            sweep.pictures.push((label, Image::from_rgb_f32(width, height, &drawn.pictures[0])?));
        }
        sweep.points.push(Point {
            views: capture.inputs.len(),
            precision: case.precision.to_owned(),
            ratio: ratio(shape),
            select: case.select.clone(),
            keep,
            tokens: shape.tokens,
            gaussians: scene.len(),
            forward_ms: Spread::of(times.iter().copied()).median,
            render_ms: Spread::of(drawn.times).median,
            peak_bytes,
            file_bytes: file_bytes(&scene)?,
            psnr: drawn.score.psnr,
            ssim: drawn.score.ssim,
            psnr_to_exact,
            views_per_cluster,
            command: command(args, case, keep),
        });
    }
    Ok(())
}

fn ratio(shape: Shape) -> f64 {
    shape.tokens as f64 / shape.grid.tokens() as f64
}

/// What was drawn in place of the photos, and how long each picture took.
struct Drawn {
    pictures: Vec<Vec<f32>>,
    times: Vec<Duration>,
    score: Score,
}

fn compare(renderer: &mut Renderer, scene: &Scene, capture: &Capture) -> Result<Drawn> {
    renderer.load(scene)?;
    // The first picture of a scene also builds the plan.
    capture.targets[0].draw(renderer)?;
    let (mut pictures, mut times) = (Vec::new(), Vec::new());
    for view in &capture.targets {
        let start = Instant::now();
        pictures.push(view.draw(renderer)?);
        times.push(start.elapsed());
    }
    let scores: Vec<Score> = capture.targets.iter().zip(&pictures).map(|(v, drawn)| capture.score(v, drawn)).collect();
    Ok(Drawn { pictures, times, score: Score::mean(&scores) })
}

/// Bytes of a scene as a PLY file.
fn file_bytes(scene: &Scene) -> Result<u64> {
    let folder = tempfile::tempdir().map_err(|error| zipsplat::Error::io("temporary folder", error))?;
    let path = folder.path().join("scene.ply");
    write_ply(scene, &path)?;
    Ok(path.metadata().map_err(|error| zipsplat::Error::io(&path, error))?.len())
}

/// Mean over clusters of the number of views that their tokens come from; nothing where nothing is clustered. A run of its
/// own: what is observed takes memory and time that a reconstruction does not.
fn views_per_cluster(model: &Model, case: &Case<'_>, images: &[Image]) -> Result<Option<f64>> {
    let Kept::Kmeans(_) = case.shape.kept else { return Ok(None) };
    let (plan, tensors) = model.record(case.shape, true)?;
    let mut run = model.run(plan)?;
    model.write_inputs(&mut run, &tensors, case.shape, images, &case.request)?;
    run.execute()?;
    let assigned = run.observed().iter().find(|(name, _)| name == "assign").map(|(_, tensor)| *tensor);
    let cluster_of_token: Vec<u32> = run.read(assigned.expect("clustering observes it"))?;
    let mut seen: Vec<(u32, usize)> = cluster_of_token
        .iter()
        .enumerate()
        .map(|(token, cluster)| (*cluster, token / case.shape.grid.patches()))
        .collect();
    seen.sort_unstable();
    seen.dedup();
    let pairs = seen.len();
    seen.dedup_by_key(|(cluster, _)| *cluster);
    Ok(Some(pairs as f64 / seen.len().max(1) as f64))
}

fn command(args: &Tradeoff, case: &Case<'_>, keep: usize) -> String {
    let mut command = format!("zipsplat eval {} --views {}", args.folder.display(), case.capture.inputs.len());
    command += &format!(" {} --keep {keep} --precision {}", case.settings, case.precision);
    command += &format!(" --targets {}", args.targets);
    if let Some(size) = args.size {
        command += &format!(" --size {size}");
    }
    command + &args.weights.as_arguments()
}
