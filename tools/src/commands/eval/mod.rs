mod alignment;
mod evaluator;
mod external_scene;
mod images;
mod one;
mod page;
mod pixels;
mod reconstruction;
mod rows;
mod series;

use crate::{
    align::Method,
    blocks::BlockArgs,
    cameras::{Finding, KnownCameras},
    capture::Choice,
    metrics::LpipsOption,
    options::{Network, Quality, Size, Weights, parse_length, refuse},
    outputs::Overwrite,
    panorama, photos,
    protocol::Filter,
    refinement::RefineArgs,
    session::Session,
    views::{Crop, CropOption, Seeing},
};
use clap::{Arg, Args, ValueEnum};
use std::{path::PathBuf, str::FromStr};
use zipsplat::{Result, refine::RefineLength, weights::Checkpoint};

/// Default of `--views`.
const VIEWS: u32 = 8;
/// Default of `--targets` with `--protocol`.
const TARGETS: usize = 8;

/// Measure quality on held-out photos of a capture, a data set, or two sets of pictures
///
/// Reconstructs a capture from some of its photos with their cameras, renders the other photos'
/// cameras, and compares. Also scores two trivial predictions: the nearest input photo, and its
/// mean color. Lengths are in the network's unit, see --scene-scale.
///
/// --pose-free gives the network photos alone. Each picture is then aligned with its photo, within
/// 15 degrees and 0.25 units of the known camera. The table lists the movements and marks
/// unreliable scores: flat, a photo without texture, not aligned; bound, a camera at its movement
/// limit; color, a picture no better than one color.
///
/// With weights of Depth Anything 3 or VGGT the scene is that of `reconstruct`, from whole photos.
/// With --pose-free, estimated cameras map it to the known world.
///
/// Two pictures, or equally named pictures in two folders, are compared by PSNR, SSIM (as in
/// scikit-image, Gaussian windows of 11 pixels) and LPIPS 0.1.
///
/// --protocol evaluates scenes as in the paper's tables 1 to 3: 8 held-out photos each, with the
/// protocol's downscaling and camera alignment. The output has a record and a picture per scene and
/// setting, scenes.csv, table.md and table.csv of means, and page.html. Run the command again to
/// resume. Failed scenes are rows of failures.csv and give exit code 1.
#[derive(Args)]
#[command(
    mut_args(for_known_cameras),
    after_help = "Examples:
  zipsplat eval capture/ --views 8
  zipsplat eval capture/ --views 8 --ratio 0.5 --csv capture.csv -o out/
  zipsplat eval photos/ --views 8 --cameras colmap --refine 100
  zipsplat eval capture/ --views 8 --targets 8 --pose-free
  zipsplat eval capture/ --views 8 --weights da3-base --input-size 504x336 --eval-size 252x252
  zipsplat eval renders/ photos/ --csv scores.csv
  zipsplat eval --protocol dl3dv DL3DV-Benchmark/ --pose-free --weights zipsplat -o dl3dv/
  zipsplat eval --protocol re10k test/ --indices ctx_6v_tgt_8v.json --weights zipsplat -o re10k/"
)]
pub struct Eval {
    /// Capture: a folder of photos with their cameras (transforms.json or a COLMAP model). To
    /// compare: two pictures or folders of pictures. With --protocol: scenes of a data set, or
    /// folders of scenes
    #[arg(required = true, value_name = "CAPTURE|PICTURES")]
    folders: Vec<PathBuf>,
    /// Cameras of the photos: transforms.json or a COLMAP model's folder; colmap: estimated by
    /// COLMAP; da3, vggt: by Depth Anything 3, VGGT [default: those in the folder]
    #[arg(long, value_name = "PATH|colmap|da3|vggt")]
    cameras: Option<PathBuf>,
    #[command(flatten)]
    finding: Finding,
    /// Number of input photos, chosen by farthest-point sampling of positions; with --protocol a
    /// list [default: 8, or the protocol's]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    views: Vec<u32>,
    /// Largest number of compared photos, evenly spaced [default: all others, 8 with --protocol]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    targets: Option<u32>,
    /// Reconstruct without the cameras, and align each picture with its photo
    #[arg(long)]
    pose_free: bool,
    /// Camera alignment: none; levenberg-marquardt (least squares near the initial camera); adam
    /// (as ZipSplat's authors: at most 200 steps, with LPIPS if available, without movement limit)
    /// [default: none with known cameras, levenberg-marquardt with --pose-free, adam with
    /// --protocol]
    #[arg(long, value_name = "HOW")]
    align: Option<Aligning>,
    #[command(flatten)]
    series: series::Options,
    #[command(flatten)]
    external: external_scene::ExternalScene,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    #[command(flatten)]
    blocks: BlockArgs,
    #[command(flatten)]
    crop: CropOption,
    /// Compare whole photos, at the scale of --input-size, even if the network sees only their
    /// center; --crop tiles always does
    #[arg(long, alias = "whole")]
    full_images: bool,
    /// Size of the compared pictures [default: that of --input-size]
    #[arg(long, alias = "score-size", value_name = "WxH")]
    eval_size: Option<Size>,
    /// Downscaling filter of the compared photos [default: lanczos; with --protocol bilinear]
    #[arg(long, value_enum, value_name = "FILTER")]
    filter: Option<Filter>,
    /// Scale photos down to this shorter side first, as the paper's table 5
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..))]
    source_side: Option<u32>,
    #[command(flatten)]
    refine: RefineArgs,
    /// Double the steps of --refine, from the start again, until the training PSNR gains less than
    /// 0.1 dB
    #[arg(long, requires = "refine")]
    converge: bool,
    /// Perturb the input cameras except the first: rotate by this number of degrees, move by as
    /// many percent of the scene's distance
    #[arg(long, alias = "disturb", value_name = "DEGREES", default_value = "0")]
    pose_noise: f64,
    /// Length of the network's unit in the cameras' unit; or the median distance of the input
    /// photos' pixels from the first camera, by weights of Depth Anything 3 or a folder with
    /// NAME.npy as --from-depth [default: as of `reconstruct`]
    #[arg(long, alias = "unit", value_name = "LENGTH|WEIGHTS|DIR")]
    scene_scale: Option<Scaling>,
    #[command(flatten)]
    lpips: LpipsOption,
    /// Table to write: view, psnr, ssim, nearest_psnr, mean_color_psnr, lpips, a row per compared
    /// photo; with learned exposures also color_corrected_psnr, or with aligned cameras
    /// unaligned_psnr, unaligned_ssim, rotation_error_deg, translation_error, warning
    #[arg(long, value_name = "FILE", conflicts_with = "protocol")]
    csv: Option<PathBuf>,
    /// Picture of the differences of two pictures, amplified four times; a folder for folders
    #[arg(long, value_name = "FILE|DIR")]
    difference: Option<PathBuf>,
    /// Folder for scene.ply, in the unit of the network's cameras, and comparison.png: photos,
    /// predictions, and nearest input photos; with --protocol for records, tables and page
    #[arg(long, short, value_name = "FOLDER", required_if_eq_any([("protocol", "dl3dv"), ("protocol", "re10k"),
        ("protocol", "mipnerf360"), ("protocol", "scannetpp")]))]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

fn for_known_cameras(arg: Arg) -> Arg {
    if arg.get_id() == "refine" { arg.conflicts_with("pose_free") } else { arg }
}

#[derive(Clone, Debug)]
enum Scaling {
    Length(f64),
    /// Weights or a folder.
    Depth(String),
}

impl FromStr for Scaling {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match (text.parse::<f64>(), parse_length(text)) {
            (Err(_), _) => Ok(Self::Depth(text.into())),
            (Ok(_), length) => length.map(Self::Length),
        }
    }
}

/// `None` disables alignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Aligning(Option<Method>);

impl FromStr for Aligning {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(Self(None));
        }
        let names: Vec<String> = Method::value_variants()
            .iter()
            .filter_map(|method| Some(method.to_possible_value()?.get_name().to_owned()))
            .collect();
        let method = Method::from_str(text, true);
        method.map(|method| Self(Some(method))).map_err(|_| format!("expected none, {}", names.join(" or ")))
    }
}

impl Eval {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match (self.series.protocol, &self.folders[..]) {
            (Some(protocol), _) => series::run(self, protocol, session),
            (None, [first, second]) => images::run(self, [first, second], session),
            (None, _) => one::run(self, session),
        }
    }

    fn begin(&self, session: &mut Session<'_>) -> Result<(Network, Seeing)> {
        let (network, crop) = (self.weights.open_network()?, self.crop.crop);
        let size = match &network {
            Network::Tokens(checkpoint) => {
                session.notes(checkpoint.notes());
                self.quality.check(checkpoint.architecture())?;
                let size = self.quality.size_for(checkpoint);
                crop.check(size, !self.pose_free)?;
                session.notes(self.quality.doubt_size(checkpoint));
                size
            }
            Network::Pixels(checkpoint) => self.check_pixels(checkpoint)?,
        };
        self.refine.check()?;
        let timed = self.refine.steps().is_some_and(|task| matches!(task.length, RefineLength::Time(_)));
        refuse("--converge", self.converge && timed, "a --refine of a time", "a number of steps")?;
        let other = self.aligning().is_some() || self.series.protocol.is_some();
        let given = self.finding.masks().is_some() && other;
        refuse("--masks", given, "aligned cameras or a --protocol", "a capture with known cameras")?;
        if self.external.given().is_none() {
            let input = &self.external.input;
            input.refuse_dropping("without --scene", "with --scene")?;
            if self.refine.steps().is_none() {
                input.antialiasing.refuse("without --scene or --refine", "with one of them")?;
            }
        }
        let usual = if self.series.protocol.is_some() { Filter::Bilinear } else { Filter::Lanczos };
        let (filter, compared) = (self.filter.unwrap_or(usual), self.eval_size.unwrap_or(size));
        let (whole, source_side) = (self.full_images || crop == Crop::Tiles, self.source_side);
        Ok((network, Seeing { crop, size, compared, whole, filter, source_side }))
    }

    fn length(&self) -> Option<f64> {
        if let Some(Scaling::Length(length)) = self.scene_scale { Some(length) } else { None }
    }

    fn aligning(&self) -> Option<Method> {
        let usual = match self.series.protocol {
            Some(_) => Some(Method::Adam),
            None => self.pose_free.then_some(Method::LevenbergMarquardt),
        };
        self.align.map_or(usual, |Aligning(method)| method)
    }

    fn check_shape(&self, checkpoint: &Checkpoint, seeing: Seeing, choice: &Choice) -> Result<()> {
        let views = seeing.crop.count(&choice.inputs(), &choice.input_frames())?;
        let shape = |views| self.quality.shape(checkpoint.architecture(), views, seeing.size, !self.pose_free);
        self.blocks.check(views, shape)
    }

    fn known(&self, folder: &PathBuf, session: &mut Session<'_>) -> Result<Option<KnownCameras>> {
        let Some(path) = &self.cameras else { return Ok(None) };
        let photos = photos::list(session, std::slice::from_ref(folder), false)?;
        if KnownCameras::to_find(path) {
            panorama::refuse(&photos)?;
        }
        let mut known = KnownCameras::of(session, path, &photos, &self.finding)?;
        let photos = photos::posed(session, photos, &known)?;
        // Those of the camera file may lie elsewhere.
        known.poses.frames.iter_mut().for_each(|frame| frame.photo = None);
        known.poses.attach(&photos)?;
        Ok(Some(known))
    }
}
