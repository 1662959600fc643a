//! `zipsplat eval`: reconstructs a capture from some of its photos and compares pictures of it with the others.

mod alignment;

use crate::{
    align::Method,
    cameras::{Finding, Known},
    capture::{Capture, Choice, Posed, Score, Seeing, draw},
    options::{Quality, Size, Weights, parse_length},
    outputs::{self, Overwrite},
    perceptual::LpipsOption,
    photos,
    refinement::{self, Moved, Refinable, Start, Steps},
    session::Session,
    table::Table,
    views::{Fit, FitOption},
};
use alignment::Alignment;
use clap::{ArgGroup, Args};
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    gpu::Arena,
    reconstruct::{Request, Shape},
    refine::{FrozenHead, Refine, Refined, Stopped},
    stages::render::Renderer,
    types::{Image, World, WriteOptions, contact_sheet},
};

/// Files of the folder.
const SCENE: &str = "scene.ply";
const COMPARISON: &str = "comparison.png";
/// Held-out photos in the picture.
const SHOWN: usize = 12;

/// How well photos that a reconstruction has not seen are predicted
///
/// Reconstructs a capture from some of its photos with their cameras, draws the scene as each of the other photos sees it,
/// and compares. The scene is given to the network in the unit it expects: the median distance of the capture's points
/// (ply_file_path of transforms.json, points.ply, or COLMAP's points3D) from the first camera; where there are none, the distance
/// of the point that the cameras look at, else the distance between cameras. Beside PSNR and SSIM stand two trivial
/// predictions: the input photo that was taken nearest, and that photo's mean colour.
///
/// With --pose-free the network is given the photos alone. Where its scene's cameras stand is then the network's own guess, so every
/// picture is drawn with the camera from which the scene looks most like the photo, searched for within 15 degrees and 0.25 of
/// the network's unit around the camera that the capture has for it. The farther a camera goes, the more it has to gain. The
/// table says how far each went, and where its figure says little: flat, a photo without texture, which is not aligned; bound,
/// a camera that went as far as it may; colour, a picture no more like the photo than one colour is.
#[derive(Args)]
#[command(group(ArgGroup::new("moved").args(["refine_cameras", "grow"]).multiple(true).requires("refine")))]
#[command(after_help = "Examples:
  zipsplat eval capture/ --views 8
  zipsplat eval capture/ --views 8 --ratio 0.5 --csv capture.csv -o out/
  zipsplat eval photos/ --views 8 --poses find --refine 100
  zipsplat eval capture/ --views 8 --targets 8 --pose-free")]
pub struct Eval {
    /// Folder with photos and their cameras: a transforms.json or a COLMAP model; with --poses the photos alone
    folder: PathBuf,
    /// Cameras of the photos: transforms.json, a COLMAP model's folder, or find, where COLMAP finds them [default: those in the
    /// folder]
    #[arg(long, value_name = "PATH|find")]
    poses: Option<PathBuf>,
    #[command(flatten)]
    finding: Finding,
    /// Photos to reconstruct from, spread by farthest-point sampling of where they were taken
    #[arg(long, value_name = "N", default_value = "8", value_parser = clap::value_parser!(u32).range(1..))]
    views: u32,
    /// Compare with so many of the other photos, evenly spread [default: all]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    targets: Option<u32>,
    /// Reconstruct without the cameras, and align each picture with its photo
    #[arg(long)]
    pose_free: bool,
    /// How the camera of a picture is searched for
    #[arg(long, value_enum, value_name = "HOW", default_value = "levenberg-marquardt", requires = "pose_free")]
    align: Method,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    #[command(flatten)]
    fit: FitOption,
    /// Compare whole photos, at the scale of --size, also where the network sees only their middle; --fit squares always does
    #[arg(long)]
    whole: bool,
    /// Compare at this size, which the network need not see [default: that of --size]
    #[arg(long, value_name = "WxH")]
    score_size: Option<Size>,
    /// Refine the scene against the input photos as they are compared, in so many steps; :tokens moves the network's tokens, from
    /// which its head makes Gaussians, and not the Gaussians themselves
    #[arg(long, value_name = "STEPS[:tokens|gaussians]", conflicts_with = "pose_free")]
    refine: Option<Steps>,
    /// Start of the refinement [default: with the model that is built in points, where the capture has enough,
    /// else the scene]. Points of a capture may come from the held-out photos, too
    #[arg(long, value_enum, value_name = "WHAT", requires = "refine")]
    start: Option<Start>,
    /// Input photos that --refine holds out, evenly spread; 0 learns from all [default: 1 of 9 or more, none with --refine-cameras]
    #[arg(long, value_name = "K", requires = "refine")]
    hold_out: Option<usize>,
    #[command(flatten)]
    moved: Moved,
    /// Give the network and the refinement wrong cameras, to see what that costs: those of all inputs but the first are turned by
    /// so many degrees, and moved by as many percent of the scene's distance
    #[arg(long, value_name = "DEGREES", default_value = "0")]
    disturb: f64,
    /// Length in the cameras' unit that becomes the network's 1 [default: the median distance of the capture's points; without
    /// any, of what the cameras look at]
    #[arg(long, value_name = "LENGTH", value_parser = parse_length)]
    unit: Option<f64>,
    #[command(flatten)]
    lpips: LpipsOption,
    /// Table to write: view, psnr, ssim, nearest_psnr, mean_color_psnr, lpips, a row for each photo compared; with --pose-free also
    /// before_psnr, before_ssim, degrees, distance, doubt
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Folder for scene.ply, in the unit of cameras that the network was given, and comparison.png: photos, what was drawn in
    /// their place, and the nearest input photos
    #[arg(long, short, value_name = "FOLDER")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

impl Eval {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.csv.as_deref().map_or(Ok(()), |file| self.overwrite.check_file(file))?;
        if let Some(folder) = &self.output {
            outputs::check_folder(folder)?;
            self.overwrite.check_replaced([SCENE, COMPARISON].map(|name| folder.join(name)))?;
        }
        let checkpoint = self.weights.open()?;
        checkpoint.notes().iter().for_each(|note| session.note(note));
        self.quality.check(checkpoint.architecture())?;
        let (size, fit) = (self.quality.size_for(&checkpoint), self.fit.fit);
        fit.check(size, !self.pose_free)?;
        self.quality.doubt_size(&checkpoint).iter().for_each(|note| session.note(note));
        let (count, targets) = (self.views as usize, self.targets.map(|targets| targets as usize));
        let known = self.known(session)?;
        let mut choice = match &known {
            Some(known) => Choice::of(known.poses.clone(), &self.folder, count, targets)?,
            None => Choice::new(&self.folder, count, targets)?,
        };
        choice.notes().iter().for_each(|note| session.note(note));
        choice.disturb(self.disturb, self.unit)?;
        let chosen = (self.quality.ratio, &self.quality.select);
        let (views, posed) = (fit.count(&choice.inputs())?, !self.pose_free);
        let shape = Shape::new(checkpoint.architecture(), views, [size.0, size.1], chosen, posed)?;
        self.refine.map_or(Ok(()), |steps| steps.check(self.start, &self.moved))?;
        let device = session.device()?;
        let mut lpips = self.lpips.open(&device, self.pose_free && self.align == Method::Adam)?;
        let (precision, arithmetic) = self.quality.arithmetic.choose(session, &device)?;
        let compared = self.score_size.unwrap_or(size);
        let seeing = Seeing { fit, size, compared, whole: self.whole || fit == Fit::Squares };
        let (capture, _) = session.stage("load photos", |stage| choice.load(seeing, self.unit, stage))?;
        capture.notes().for_each(|note| session.note(note));

        let (model, _) = session.load_model(&device, &checkpoint, arithmetic)?;
        let images = capture.images();
        let (cameras, world) = fit.told(capture.cameras());
        let request = Request {
            ratio: self.quality.ratio,
            selection: self.quality.select.clone(),
            cameras: posed.then_some(cameras),
            unit: 1.0,
        };
        let of_tokens = self.refine.is_some_and(|steps| steps.tokens);
        let (result, tokens, took) = session.reconstruct_with_tokens(&model, &images, &request, of_tokens)?;
        let mut scene = result.scene()?;
        self.quality.prune(&mut scene, checkpoint.architecture());
        world.iter().for_each(|world| scene.place(1.0, world));
        let mut started = refinement::TOKENS;
        let refined = match (self.refine, &tokens) {
            (Some(Steps { count, .. }), Some(tokens)) => {
                let head = FrozenHead::load(&device, &checkpoint)?;
                Some(self.refine(session, model.arena(), Refinable::Tokens(&head, tokens), &capture, count)?)
            }
            (Some(Steps { count, .. }), None) => {
                let cloud = choice.points(&capture.unit)?;
                let start = Start::or_best(self.start, cloud.as_ref(), self.weights.is_embedded());
                started = start.name();
                let start = start.scene(Some(scene.clone()), cloud.as_ref(), &capture.learnt().1)?;
                Some(self.refine(session, model.arena(), Refinable::Scene(&start), &capture, count)?)
            }
            (None, _) => None,
        };
        if let Some(refined) = &refined {
            scene = refined.scene.clone();
        }
        let mut renderer = Renderer::new(&device);
        match &world {
            // Nothing was changed on the host.
            None if refined.is_none() && scene.len() == result.gaussians.len() => renderer.show(&result.gaussians)?,
            _ => renderer.load(&scene)?,
        }
        let targets = &capture.targets;
        let (drawn, mut alignment) = if self.pose_free {
            let (found, _) = session.stage("align", |stage| {
                let found = |view: &Posed| {
                    self.align.align(&mut renderer, &view.image, &view.camera, lpips.as_mut(), &|| stage.check())
                };
                stage.each(targets, found)
            })?;
            let alignment = Alignment::new(&capture, &found);
            (found.into_iter().map(|found| found.drawn).collect(), Some(alignment))
        } else {
            let picture = |view: &Posed| draw(&mut renderer, &view.camera);
            (session.stage("compare", |stage| stage.each(targets, picture))?.0, None)
        };
        let mut scores = capture.scores(&drawn);
        if let Some(lpips) = &mut lpips {
            session.stage("compare", |_| capture.look(&mut scores, &drawn, lpips))?;
            let rows = alignment.iter_mut().flat_map(|alignment| &mut alignment.rows);
            rows.zip(&scores).for_each(|(row, score)| row.lpips = score.lpips);
        }

        match (&self.csv, &alignment) {
            (Some(path), Some(alignment)) => outputs::save_csv(path, &alignment.rows)?,
            (Some(path), None) => outputs::save_csv(path, &scores)?,
            (None, _) => {}
        }
        if let Some(folder) = &self.output {
            outputs::make_folder(folder)?;
            // Drawn and compared in the network's unit, kept in that of the cameras that it was given.
            if posed {
                scene.scale(capture.unit.length as f32);
            }
            let world = posed.then(|| World::Photo(capture.inputs[0].name.clone()));
            let options = WriteOptions::default();
            outputs::save_scene(&folder.join(SCENE), &scene, &options, world.as_ref())?;
            outputs::save_picture(&folder.join(COMPARISON), &comparison(&capture, &drawn)?)?;
        }
        let mean = Score::mean(&scores);
        let table = alignment.as_ref().map_or_else(|| table(&scores, &mean), |alignment| alignment.table(&mean));
        alignment.iter().filter_map(Alignment::doubts).for_each(|note| session.note(note));
        let text = format!(
            "{table}{} of {size} from {} of its photos, {} Gaussians of {} tokens in {:.2} s; {}",
            self.folder.display(),
            capture.inputs.len(),
            scene.len(),
            result.tokens,
            took.as_secs_f64(),
            capture.unit
        ) + &alignment.as_ref().map_or_else(String::new, Alignment::told)
            + &refined.as_ref().map_or_else(String::new, |refined| {
                format!("\n{}", refinement::summary(refined, started, &capture.learnt().1))
            });
        let json = serde_json::json!({
            "folder": self.folder, "weights": checkpoint.provenance(), "precision": precision.name(), "width": size.0, "height": size.1,
            "score_width": compared.0, "score_height": compared.1, "refined": refined.as_ref().map(|refined| refinement::as_json(refined, started, &capture.learnt().1)),
            "inputs": capture.inputs.iter().map(|view| &view.name).collect::<Vec<_>>(), "unit": capture.unit.length, "unit_from": capture.unit.source,
            "tokens": result.tokens, "all_tokens": shape.grid.tokens(), "gaussians": scene.len(),
            "peak_bytes": result.peak_bytes, "seconds": took.as_secs_f64(),
            "mean": mean, "aligned": alignment, "views": scores,
        });
        session.report(&json, text)
    }

    /// The cameras of the folder's photos, where they are not in it.
    fn known(&self, session: &mut Session<'_>) -> Result<Option<Known>> {
        let Some(path) = &self.poses else { return Ok(None) };
        let photos = photos::list(session, std::slice::from_ref(&self.folder))?;
        let mut known = Known::of(session, path, &photos, &self.finding)?;
        // The photos are those of the folder, wherever the file of their cameras lies.
        for photo in photos::posed(session, photos, &known.poses)? {
            let place = known.poses.frames_of(&[&photo])?[0].name.clone();
            known
                .poses
                .frames
                .iter_mut()
                .filter(|frame| frame.name == place)
                .for_each(|frame| frame.photo = Some(photo.clone()));
        }
        Ok(Some(known))
    }

    /// Refines a scene against the inputs as they are compared.
    fn refine(
        &self,
        session: &mut Session<'_>,
        arena: &Arena,
        from: Refinable<'_>,
        capture: &Capture,
        steps: usize,
    ) -> Result<Refined> {
        let (photos, cameras) = capture.learnt();
        let request = self.moved.request(Refine { steps, hold_out: self.hold_out, ..Refine::default() });
        let refined = refinement::refine(session, arena, from, &photos, &cameras, &request)?;
        refinement::doubt(&refined).iter().for_each(|note| session.note(note));
        match refined.stopped {
            Some(Stopped::Cancelled) => Err(Error::Cancelled),
            _ => Ok(refined),
        }
    }
}

fn table(scores: &[Score], mean: &Score) -> Table {
    let mut table = Table::new(1, &["view", "PSNR", "SSIM", "LPIPS", "nearest photo", "mean colour"]);
    scores.iter().chain([mean]).for_each(|score| table.row(cells_of(score)));
    table
}

fn cells_of(score: &Score) -> [String; 6] {
    cells(&score.view, [score.psnr, score.ssim, score.nearest_psnr, score.mean_color_psnr], score.lpips)
}

/// PSNR, SSIM, LPIPS and the PSNR of the two predictions.
fn cells(view: &str, [psnr, ssim, nearest, color]: [f64; 4], lpips: Option<f64>) -> [String; 6] {
    let db = |value: f64| format!("{value:.2} dB");
    let lpips = lpips.map_or("-".into(), |lpips| format!("{lpips:.3}"));
    [view.to_owned(), db(psnr), format!("{ssim:.3}"), lpips, db(nearest), db(color)]
}

/// For some of the photos, evenly spread, two in a row: the photo, what was drawn, the nearest input.
fn comparison(capture: &Capture, drawn: &[Vec<f32>]) -> Result<Image> {
    let targets = &capture.targets;
    let shown = targets.len().min(SHOWN);
    let mut images = Vec::new();
    for i in (0..shown).map(|i| i * targets.len() / shown) {
        let Image { width, height, .. } = targets[i].image;
        let drawn = Image::from_rgb_f32(width, height, &drawn[i])?;
        images.extend([targets[i].image.clone(), drawn, capture.nearest(&targets[i]).image.clone()]);
    }
    contact_sheet(&images, 6)
}
