use super::{
    Eval, Scaling, TARGETS,
    evaluator::{Evaluation, Evaluator},
    page,
    rows::{self, Means, Row},
};
use crate::{
    capture::Score,
    options::{Network, Quality, parse_ratio, parse_selection},
    outputs::{self, FAILURES, Failure, MADE_BY},
    protocol::{Place, Protocol, Setting},
    session::Session,
    stamp::{digest, hash_of_weights, stamp},
    table::{Table, counted},
    views::Seeing,
};
use clap::Args;
use indicatif::HumanDuration;
use std::{
    path::{Path, PathBuf},
    time::Instant,
};
use zipsplat::{
    Error, Result,
    gpu::cache_dir,
    reconstruct::{Ratio, TokenSelection},
    types::{Image, contact_sheet, write_atomic},
};

const SCENES: &str = "scenes.csv";
const TABLES: [&str; 2] = ["table.md", "table.csv"];
const PAGE: &str = "page.html";
const SHOWN: usize = 4;

#[derive(Args)]
pub struct Options {
    /// Evaluate scenes of a data set by the paper's protocol
    #[arg(long, value_enum, value_name = "DATA", conflicts_with = "cameras")]
    pub protocol: Option<Protocol>,
    /// Choose inputs and targets among the first FRAMES frames: one value, or one per value of
    /// --views [default: for dl3dv 50, 100 and 150 with 6, 12 and 24 inputs; else all]
    #[arg(long, alias = "gap", value_name = "FRAMES", value_delimiter = ',', requires = "protocol")]
    frame_range: Vec<usize>,
    /// Choose the frames of index files, one per number of inputs: {"SCENE": {"context": [0, 19,
    /// ..], "target": [1, 6, ..]}}, in the order of the camera file. Skips other scenes
    #[arg(long, value_name = "FILE", value_delimiter = ',', requires = "protocol",
        conflicts_with_all = ["frame_range", "views", "targets"])]
    indices: Vec<PathBuf>,
    /// Folder of the photos within a scene [default: the data set's, such as images_4]
    #[arg(long, value_name = "NAME", requires = "protocol")]
    images: Option<PathBuf>,
    /// Keep the lens distortion of the photos, as the paper's authors do with DL3DV
    #[arg(long, requires = "protocol")]
    keep_distortion: bool,
    /// Name of the method in the tables [default: that of the weights]
    #[arg(long, value_name = "NAME", requires = "protocol")]
    name: Option<String>,
    /// Evaluate each of these --ratio, a row each
    #[arg(long, value_name = "R,..", value_delimiter = ',', requires = "protocol", value_parser = parse_ratio,
        conflicts_with = "ratio")]
    ratios: Vec<Ratio>,
    /// Evaluate each of these --token-selection, a row each
    #[arg(long, value_name = "HOW,..", value_delimiter = ',', requires = "protocol", value_parser = parse_selection,
        conflicts_with = "token_selection")]
    token_selections: Vec<TokenSelection>,
    /// Largest number of scenes evaluated in this run
    #[arg(long, value_name = "N", requires = "protocol")]
    limit: Option<usize>,
}

struct Series<'a> {
    eval: &'a Eval,
    protocol: Protocol,
    method: String,
    folder: PathBuf,
}

enum Outcome {
    Evaluated,
    Unchanged,
    /// Missing from the index file.
    Unknown,
}

#[derive(Default)]
struct Tally {
    evaluated: usize,
    unchanged: usize,
    unknown: usize,
    failures: Vec<Failure>,
}

pub fn run(eval: &Eval, protocol: Protocol, session: &mut Session<'_>) -> Result<()> {
    let out = eval.output.as_deref().expect("clap requires it with --protocol");
    outputs::check_folder(out)?;
    let files = [SCENES, PAGE, FAILURES].into_iter().chain(TABLES).map(|name| out.join(name));
    eval.overwrite.check_replaced(files)?;
    eval.lpips.file(cache_dir().as_deref(), true)?;
    let options = &eval.series;
    let settings = protocol.settings(&eval.views, &options.frame_range, &options.indices)?;
    let places = protocol.places(&eval.folders, options.images.as_deref())?;
    let (weights, seeing) = eval.begin(session)?;
    outputs::make_folder(out)?;
    let mut evaluator = Evaluator::new(eval, &weights, seeing, session)?;
    let method = options.name.clone().unwrap_or_else(|| method_of(&weights, eval));
    let key = eval.settings_key(&weights, seeing, &evaluator)?;
    let posed = if eval.pose_free { "free" } else { "posed" };

    // Failures of an earlier run.
    std::fs::remove_file(out.join(FAILURES)).ok();
    let (mut tally, mut ended) = (Tally::default(), Ok(()));
    for (suffix, quality) in options.variants(&eval.quality) {
        let (method, way) = (format!("{method}{suffix}"), digest(&[format!("{key} {quality:?}")]));
        let folder = out.join(format!("{}-{posed}-{}", slug(&method), &way[..8]));
        evaluator.quality = quality;
        let series = Series { eval, protocol, method, folder };
        ended = ended.and_then(|()| series.run(&places, &settings, &mut evaluator, &mut tally, session));
    }
    let rows = rows::read_all(out, protocol)?;
    let means = Means::of(protocol, &rows);
    outputs::save_csv(&out.join(SCENES), &rows)?;
    for (name, text) in TABLES.into_iter().zip([means.markdown(), means.csv()]) {
        write_atomic(&out.join(name), |file| file.write_all(text.as_bytes()))?;
    }
    let page = page::page(&means, &rows)?;
    write_atomic(&out.join(PAGE), |file| file.write_all(page.as_bytes()))?;
    if !tally.failures.is_empty() {
        outputs::save_csv(&out.join(FAILURES), &tally.failures)?;
    }
    outputs::note_failures(session, out, &tally.failures, "scene");
    ended?;
    report(session, out, protocol, &rows, &means, &tally)
}

impl Series<'_> {
    fn run(
        &self,
        places: &[Place],
        settings: &[Setting],
        evaluator: &mut Evaluator<'_>,
        tally: &mut Tally,
        session: &mut Session<'_>,
    ) -> Result<()> {
        let limit = self.eval.series.limit.unwrap_or(usize::MAX);
        let (all, began) = (places.len() * settings.len(), Instant::now());
        let (evaluated, unknown) = (tally.evaluated, tally.unknown);
        for (i, (place, setting)) in places.iter().flat_map(|p| settings.iter().map(move |s| (p, s))).enumerate() {
            if tally.evaluated >= limit {
                break;
            }
            let scene = format!("{} of {all}, {} {}", i + 1, place.name, setting.name());
            // Existing records take no time.
            let done = (tally.evaluated - evaluated) as u32;
            let rest = began.elapsed().checked_div(done).map(|each| each * (all - i) as u32);
            let rest = rest.map_or_else(String::new, |rest| format!(", all in about {}", HumanDuration(rest)));
            session.task = format!("{scene}{rest}: ");
            match self.evaluate(place, setting, evaluator, &scene, session) {
                Ok(Outcome::Evaluated) => tally.evaluated += 1,
                Ok(Outcome::Unchanged) => tally.unchanged += 1,
                Ok(Outcome::Unknown) => tally.unknown += 1,
                Err(error) if Failure::is_of_all(&error) => return Err(error),
                Err(error) => {
                    session.note(format!("{scene}: {error}"));
                    tally.failures.push(Failure::new(scene, &error));
                }
            }
        }
        if tally.unknown - unknown == all {
            let expected = format!("names of scenes among {}", self.eval.folders[0].display());
            return Err(Error::argument("--indices", "none of the scenes", expected));
        }
        Ok(())
    }

    fn evaluate(
        &self,
        place: &Place,
        setting: &Setting,
        evaluator: &mut Evaluator<'_>,
        label: &str,
        session: &mut Session<'_>,
    ) -> Result<Outcome> {
        let eval = self.eval;
        let targets = eval.targets.map_or(TARGETS, |targets| targets as usize);
        let poses = place.read(eval.series.keep_distortion)?;
        let Some(mut choice) = setting.choose(&place.name, poses, targets)? else { return Ok(Outcome::Unknown) };
        let mut parts = vec![choice.digest()?];
        for input in eval.external.inputs(&place.name)? {
            parts.push(stamp(&input)?);
        }
        let hash = digest(&parts);
        let folder = self.folder.join(format!("{}-{}", setting.name(), setting.rule()));
        let file = Row::file(&folder, &place.name);
        if Row::read(&file).is_some_and(|row| row.hash == hash) {
            return Ok(Outcome::Unchanged);
        }
        choice.disturb(eval.pose_noise, eval.length())?;
        let evaluation = evaluator.evaluate(session, &choice, Some(&place.name))?;
        let mean = Score::mean(&evaluation.scores);
        let row = Row {
            generator: MADE_BY.into(),
            protocol: rows::name_of(self.protocol),
            method: self.method.clone(),
            posed: !eval.pose_free,
            scene: place.name.clone(),
            views: setting.views,
            rule: setting.rule(),
            hash,
            targets: evaluation.scores.len(),
            gaussians: evaluation.reconstruction.scene.len(),
            psnr: mean.psnr,
            ssim: mean.ssim,
            lpips: mean.lpips,
            seconds: evaluation.reconstruction.network.as_ref().map(|network| network.took.as_secs_f64()),
            place: folder.clone(),
        };
        outputs::make_folder(&folder)?;
        outputs::save_picture(&file.with_extension("png"), &pictures(&evaluation)?)?;
        outputs::save_json(&file, &row)?;
        session.note(format!("{label}: {:.2} dB", row.psnr));
        Ok(Outcome::Evaluated)
    }
}

fn report(
    session: &mut Session<'_>,
    out: &Path,
    protocol: Protocol,
    rows: &[Row],
    means: &Means,
    Tally { evaluated, unchanged, unknown, failures }: &Tally,
) -> Result<()> {
    let mut table = Table::new(3, &means.headings);
    means.lines.iter().for_each(|line| table.row(line.clone()));
    let text = format!("{table}{}: {} of {} evaluated", out.display(), counted(*evaluated, "scene"), means.title);
    let others = [(*unchanged, "there already"), (*unknown, "not in --indices"), (failures.len(), "failed")];
    let text = outputs::and_others(text, &others);
    let json = serde_json::json!({
        "output": out.to_string_lossy(), "protocol": rows::name_of(protocol), "evaluated": evaluated, "skipped": unchanged, "unknown": unknown,
        "failed": failures.len(), "headings": means.headings, "means": means.lines, "scenes": rows,
    });
    session.report(&json, text)
}

impl Options {
    /// Every combination of ratios and selections, with the end of its method's name.
    fn variants(&self, quality: &Quality) -> Vec<(String, Quality)> {
        fn or<'a, T>(list: &'a [T], one: &'a T) -> &'a [T] {
            if list.is_empty() { std::slice::from_ref(one) } else { list }
        }
        let selections = or(&self.token_selections, &quality.token_selection);
        let variant = |(ratio, selection): (&Ratio, &TokenSelection)| {
            let of_ratio = match ratio {
                _ if self.ratios.is_empty() => String::new(),
                Ratio::Auto => " r=auto".into(),
                Ratio::Fixed(ratio) => format!(" r={ratio}"),
            };
            let of_selection = match selection {
                _ if self.token_selections.is_empty() => String::new(),
                selection => format!(" {selection}"),
            };
            let mut variant = quality.clone();
            (variant.ratio, variant.token_selection) = (*ratio, selection.clone());
            (of_ratio + &of_selection, variant)
        };
        let ratios = or(&self.ratios, &quality.ratio).iter();
        ratios.flat_map(|ratio| selections.iter().map(move |s| (ratio, s))).map(variant).collect()
    }
}

impl Eval {
    fn settings_key(&self, weights: &Network, seeing: Seeing, evaluator: &Evaluator<'_>) -> Result<String> {
        let (version, precision) = (env!("CARGO_PKG_VERSION"), evaluator.precision.name());
        let Self { refine, converge, pose_noise, scene_scale, blocks, finding, .. } = self;
        let weights = hash_of_weights(Path::new(weights.provenance()))? + weights.provenance();
        let network = format!("{weights} {precision} {blocks:?} {:?}", finding.cameras);
        let lpips = self.lpips.file(evaluator.device.cache_dir(), true)?;
        let lpips = lpips.map(|(_, path)| hash_of_weights(&path)).transpose()?;
        let scaler = if let Some(Scaling::Depth(from)) = scene_scale {
            hash_of_weights(Path::new(from))?
        } else {
            String::new()
        };
        Ok(format!(
            "{version} {network} {seeing:?} {:?} {refine:?} {converge} {pose_noise} {scene_scale:?} {scaler} {lpips:?} {} {}",
            self.aligning(),
            self.series.keep_distortion,
            self.external.key()
        ))
    }
}

fn method_of(weights: &Network, eval: &Eval) -> String {
    if let Some(folder) = eval.external.given() {
        return folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    }
    let weights = Path::new(weights.provenance());
    let name = if weights.is_file() { weights.file_stem() } else { weights.file_name() };
    let name = name.unwrap_or_default().to_string_lossy();
    let converged = if eval.converge { ", converged" } else { "" };
    match eval.refine.steps() {
        Some(steps) if steps.tokens => format!("{name} + TTO{converged}"),
        Some(_) => format!("{name} + refinement{converged}"),
        None => name.into_owned(),
    }
}

fn slug(name: &str) -> String {
    let letters = name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' });
    letters.collect()
}

fn pictures(evaluation: &Evaluation) -> Result<Image> {
    let targets = &evaluation.capture.targets;
    let shown = targets.len().min(SHOWN);
    let chosen: Vec<usize> = (0..shown).map(|i| i * targets.len() / shown).collect();
    let mut images: Vec<Image> = chosen.iter().map(|i| targets[*i].image.clone()).collect();
    for i in chosen {
        let Image { width, height, .. } = targets[i].image;
        images.push(Image::from_rgb_f32(width, height, &evaluation.drawn[i])?);
    }
    contact_sheet(&images, shown)
}
