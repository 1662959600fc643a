mod case;
mod drawn;
mod figures;
mod page;
mod point;
mod rounded;
mod sweep;
mod truth;

use super::timed_device;
use crate::{
    capture::{Choice, ViewSplit},
    options::{Keep, PrecisionName, Size, Weights, parse_length, parse_ratio, parse_selection},
    outputs::{self, Overwrite},
    plot,
    refinement::{Initialization, RefineTask},
    session::Session,
    views::Seeing,
};
use clap::Args;
use std::{path::PathBuf, str::FromStr, time::Duration};
use zipsplat::{
    Result,
    gpu::Device,
    ops::{Arithmetic, Precision},
    reconstruct::{KvPool, Ratio, TokenSelection},
    types::{PointCloud, write_atomic},
    weights::{Checkpoint, Dtype},
};

/// Quality over time: sweeps settings over a capture, with plots, pictures and a table
///
/// Compares every combination of the lists with held-out photos, most informative first. The page
/// recommends a fast, a balanced and a best setting, and shows each point's picture and command.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat bench tradeoff capture/ -o report/
  zipsplat bench tradeoff capture/ --minutes all -o report/
  zipsplat bench tradeoff capture/ --views 4,8,16,24 --ratio 1,0.5,auto -o report/
  zipsplat bench tradeoff capture/ --views 8,16 --ratio 1,auto --dtype f16,q8 --refine 0 -o report/
  zipsplat bench tradeoff capture/ --views 16 --ratio 1,auto --precision fp16 --refine 0,10,25,50,100,50:tokens -o report/

Writes tradeoff.html, a self-contained page, its table tradeoff.csv, the front tradeoff.svg,
and figures.svg with the paper's figures 1, 8, 10, 11 b and 12 b. Ctrl-C ends the sweep
and writes its results.

Reconstructions of at most 20 GFLOP are also computed in f64 on the CPU, with the tokens
that the first precision selected. The table has the RMS error of each stage relative to
the RMS of its f64 result, and the PSNR between renders of both. Weights rounded by
--dtype are compared with the f64 result of the weights as stored.")]
pub struct Tradeoff {
    /// Folder with photos and their cameras: a transforms.json or a COLMAP model
    folder: PathBuf,
    /// Numbers of photos to reconstruct from
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "8,4,2")]
    views: Vec<usize>,
    /// Shares of the tokens that become Gaussians, or auto
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,0.25,0.5,0.1,0.05",
        value_parser = parse_ratio)]
    ratio: Vec<Ratio>,
    /// Token selections: kmeans[:ROUNDS], mutual, stride, random[:SEED], files of indices
    #[arg(long, alias = "select", value_name = "LIST", value_delimiter = ',', default_value = "kmeans,kmeans:1,kmeans:10,stride,random",
        value_parser = parse_selection)]
    token_selection: Vec<TokenSelection>,
    /// Keys and values of attention across views
    #[arg(long, alias = "pool", value_name = "LIST", value_delimiter = ',', default_value = "1")]
    kv_pool: Vec<KvPool>,
    /// Gaussians kept per token, by visibility [default: all, a half, a quarter]
    #[arg(long, alias = "keep", value_name = "LIST", value_delimiter = ',')]
    max_gaussians_per_token: Option<Vec<Keep>>,
    /// Refinement steps, or 100:tokens for the scene's tokens; 0 is always included. Combined with
    /// every number of photos and ratio, with all Gaussians, otherwise first values
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "0,10,50")]
    refine: Vec<RefineTask>,
    /// Initializations of the refinement [default: scene, and points if the capture has them]
    #[arg(long, alias = "start", value_name = "LIST", value_delimiter = ',', value_enum)]
    init: Option<Vec<Initialization>>,
    /// Arithmetics: fp32, fp16, bf16, int8 [default: all that the device has]
    #[arg(long, value_name = "LIST", value_delimiter = ',', value_enum)]
    precision: Option<Vec<PrecisionName>>,
    /// Types to round the weights to: f16, bf16, q8; the weights as stored are always included.
    /// Combined with every number of photos and ratio, otherwise first values
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "q8", value_parser = rounded::parse)]
    dtype: Vec<Option<Dtype>>,
    /// Largest number of compared photos
    #[arg(long, value_name = "N", default_value = "6", value_parser = clap::value_parser!(u32).range(1..))]
    targets: u32,
    #[command(flatten)]
    weights: Weights,
    /// Network input size [default: the trained size]
    #[arg(long, value_name = "WxH")]
    input_size: Option<Size>,
    /// Length of the network's unit in the cameras' unit [default: as of `reconstruct`]
    #[arg(long, alias = "unit", value_name = "LENGTH", value_parser = parse_length)]
    scene_scale: Option<f64>,
    /// Untimed runs before the measurement
    #[arg(long, value_name = "N", default_value = "1")]
    warmup: u32,
    /// Timed runs
    #[arg(long, value_name = "N", default_value = "3", value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Time limit of the sweep; the current point is finished
    #[arg(long, value_name = "N|all", default_value = "5")]
    minutes: Minutes,
    /// Folder for the page, the table and the plots
    #[arg(long, short, value_name = "FOLDER")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Minutes(Option<Duration>);

impl FromStr for Minutes {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(Self(None));
        }
        let minutes = text.parse().ok().filter(|minutes: &f64| *minutes > 0.0);
        let time = minutes.and_then(|minutes| Duration::try_from_secs_f64(60.0 * minutes).ok());
        time.map(|time| Self(Some(time))).ok_or_else(|| "expected minutes above 0, or all".into())
    }
}

impl Tradeoff {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        outputs::check_folder(&self.output)?;
        let [html, csv, svg, sheet] =
            ["tradeoff.html", "tradeoff.csv", "tradeoff.svg", "figures.svg"].map(|name| self.output.join(name));
        self.overwrite.check_replaced([&html, &csv, &svg, &sheet])?;
        let checkpoint = self.weights.open()?;
        let size = Size::or_best(self.input_size, &checkpoint);
        sweep::check(self, checkpoint.architecture(), size)?;
        let choices: Vec<Choice> = (self.views.iter())
            .map(|views| Choice::new(&self.folder, *views, Some(self.targets as usize)))
            .collect::<Result<_>>()?;
        let device = timed_device(session)?;
        let captures: Vec<ViewSplit> = (choices.iter())
            .map(|choice| {
                Ok(session.stage("load photos", |stage| choice.load(Seeing::cropped(size), self.scene_scale, stage))?.0)
            })
            .collect::<Result<_>>()?;
        captures.iter().take(1).flat_map(ViewSplit::notes).for_each(|note| session.note(note));
        let clouds: Vec<Option<PointCloud>> = (choices.iter().zip(&captures))
            .map(|(choice, capture)| choice.points(&capture.scene_scale))
            .collect::<Result<_>>()?;
        let arithmetics = self.arithmetics(session, &device, &checkpoint)?;
        let rounded = rounded::all(self, session, &checkpoint)?;
        let networks = sweep::Networks { checkpoint: &checkpoint, rounded: &rounded, arithmetics: &arithmetics };
        let (sweep, error) = sweep::run(self, session, &device, networks, &captures, &clouds)?;

        outputs::make_folder(&self.output)?;
        let (pareto, figures) = (figures::pareto(&sweep.points), figures::figures(&sweep));
        let (name, weights) = (&device.limits().name, checkpoint.provenance());
        let page = page::page(self, name, weights, &captures, &sweep, &pareto, &figures)?;
        let repeatable: Vec<(&str, String)> = figures
            .into_iter()
            .filter(|figure| figure.is_repeatable)
            .map(|figure| (figure.heading, figure.plot))
            .collect();
        write_atomic(&html, |out| out.write_all(page.as_bytes()))?;
        for (path, svg) in [(&svg, pareto), (&sheet, plot::sheet(&repeatable))] {
            write_atomic(path, |out| write!(out, "<!-- zipsplat -->\n{svg}"))?;
        }
        outputs::save_csv(&csv, &sweep.points)?;
        let (measured, planned) = (sweep.points.len(), sweep.planned);
        if let Some(error) = error {
            session.note(format!("{} has the {measured} of {planned} points that were measured", html.display()));
            return Err(error);
        }
        if measured < planned {
            session.note(format!(
                "{} has the {measured} most informative of {planned} points; --minutes all measures every one",
                html.display()
            ));
        }
        let front = point::front(&sweep.points).len();
        let text = format!(
            "{}: {measured} points, {front} of them on the front of time and PSNR\n{}: the same as a table\n{}: the front",
            html.display(),
            csv.display(),
            svg.display()
        );
        session.report(&sweep.points, text)
    }

    /// All by default, `fp32` first.
    fn arithmetics(
        &self,
        session: &mut Session<'_>,
        device: &Device,
        checkpoint: &Checkpoint,
    ) -> Result<Vec<(Precision, Arithmetic)>> {
        let asked = self.precision.as_ref().map(|names| {
            let best = Precision::best(device.limits());
            names.iter().map(|name| name.precision().unwrap_or(best)).collect()
        });
        let suits = |arithmetic| checkpoint.suits(arithmetic).is_ok();
        let has = |precision: &Precision| Arithmetic::of(*precision, device.limits()).is_some_and(suits);
        let mut precisions: Vec<Precision> = asked.unwrap_or_else(|| Precision::ALL.into_iter().filter(has).collect());
        precisions.sort_by_key(|precision| *precision != Precision::Fp32);
        precisions.dedup();
        precisions.into_iter().map(|precision| session.choose(device, Some(precision))).collect()
    }
}
