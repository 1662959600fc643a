//! `zipsplat eval`: reconstructs captures from some of their photos and compares pictures of them with the others.

mod alignment;
mod depth;
mod judge;
mod one;
mod page;
mod pixels;
mod rows;
mod series;
mod theirs;

use crate::{
    align::Method,
    cameras::{Finding, Known},
    capture::Choice,
    options::{Network, Quality, Size, Weights, parse_length, refuse},
    outputs::Overwrite,
    perceptual::LpipsOption,
    photos,
    protocol::Filter,
    refinement::{DEFAULT_STEPS, Moved, Start, Steps},
    session::Session,
    views::{Fit, FitOption, Seeing},
};
use clap::{ArgGroup, Args, ValueEnum};
use std::{path::PathBuf, str::FromStr};
use zipsplat::{Result, reconstruct::Shape, weights::Checkpoint};

/// Input photos of a capture, where nobody says.
const VIEWS: u32 = 8;
/// Photos of a scene that a protocol compares with, where nobody says.
const TARGETS: usize = 8;

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
///
/// With weights of Depth Anything 3 the scene is that of `reconstruct`: each pixel of the whole photos that the network is confident of,
/// whose longer side --size says. With --pose-free it is brought to the cameras given by those that the network finds.
///
/// With --protocol the folders are scenes of a data set, or folders of them, and are judged as the paper's tables 1 to 3 are: 8
/// photos of each, made small by its filter, and cameras aligned as its authors do, given to the network or not. OUT has a folder for
/// each way to judge, with a record and a picture of every scene; scenes.csv, a row a scene; table.md and table.csv, means in the shape
/// of the paper's tables; and page.html, with pictures. The same command goes on where it was. A scene that fails is a row of
/// failures.csv, and the others go on; the exit code is then 1.
#[derive(Args)]
#[command(group(ArgGroup::new("moved").args(["refine_cameras", "grow", "lpips_weight"]).multiple(true).requires("refine")))]
#[command(after_help = "Examples:
  zipsplat eval capture/ --views 8
  zipsplat eval capture/ --views 8 --ratio 0.5 --csv capture.csv -o out/
  zipsplat eval photos/ --views 8 --poses find --refine 100
  zipsplat eval capture/ --views 8 --targets 8 --pose-free
  zipsplat eval capture/ --views 8 --weights da3-base --size 504x336 --score-size 252x252
  zipsplat eval --protocol dl3dv DL3DV-Benchmark/ --pose-free --weights zipsplat -o dl3dv/
  zipsplat eval --protocol re10k test/ --indices ctx_6v_tgt_8v.json --weights zipsplat -o re10k/")]
pub struct Eval {
    /// Folder with photos and their cameras: a transforms.json or a COLMAP model; with --poses the photos alone; with --protocol scenes
    /// of a data set, or folders of them
    #[arg(required = true, value_name = "FOLDER")]
    folders: Vec<PathBuf>,
    /// Cameras of the photos: transforms.json, a COLMAP model's folder, find, where COLMAP finds them, or da3, where Depth Anything 3
    /// does [default: those in the folder]
    #[arg(long, alias = "cameras", value_name = "PATH|find|da3")]
    poses: Option<PathBuf>,
    #[command(flatten)]
    finding: Finding,
    /// Photos to reconstruct from, spread by farthest-point sampling of where they were taken; of a protocol a list [default: 8, or the
    /// protocol's]
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    views: Vec<u32>,
    /// Compare with so many of the other photos, evenly spread [default: all, of a protocol 8]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    targets: Option<u32>,
    /// Reconstruct without the cameras, and align each picture with its photo
    #[arg(long)]
    pose_free: bool,
    /// How the camera of a picture is searched for: none, levenberg-marquardt (least squares, from small pictures to large ones; the
    /// camera stays near where it was), adam (as ZipSplat's authors do: at most 200 steps, with a term of LPIPS where its weights are;
    /// the camera may go anywhere) [default: none with known cameras, levenberg-marquardt with --pose-free, adam with --protocol]
    #[arg(long, value_name = "HOW")]
    align: Option<Aligning>,
    #[command(flatten)]
    series: series::Options,
    #[command(flatten)]
    theirs: theirs::Theirs,
    #[command(flatten)]
    weights: Weights,
    #[command(flatten)]
    quality: Quality,
    #[command(flatten)]
    fit: FitOption,
    /// Compare whole photos, at the scale of --size, also where the network sees only their middle; --fit squares always does
    #[arg(long, alias = "full-images")]
    whole: bool,
    /// Compare at this size, which the network need not see [default: that of --size]
    #[arg(long, alias = "eval-size", value_name = "WxH")]
    score_size: Option<Size>,
    /// How photos are made small, for the network and to compare [default: lanczos, of a protocol bilinear]
    #[arg(long, value_enum, value_name = "HOW")]
    filter: Option<Filter>,
    /// Refine the scene against the input photos as they are compared, in so many steps; :tokens moves the network's tokens, from
    /// which its head makes Gaussians, and not the Gaussians themselves
    #[arg(long, value_name = "STEPS[:tokens|gaussians]", num_args = 0..=1, require_equals = true,
        default_missing_value = DEFAULT_STEPS, conflicts_with = "pose_free")]
    refine: Option<Steps>,
    /// Start of the refinement [default: with the model that is built in points, where the capture has enough,
    /// else the scene]. Points of a capture may come from the held-out photos, too
    #[arg(long, alias = "init", value_enum, value_name = "WHAT", requires = "refine")]
    start: Option<Start>,
    /// Input photos that --refine holds out, evenly spread; 0 learns from all [default: 1 of 9 or more, none with --refine-cameras]
    #[arg(long, alias = "holdout-views", value_name = "K", requires = "refine")]
    hold_out: Option<usize>,
    #[command(flatten)]
    moved: Moved,
    /// Give the network and the refinement wrong cameras, to see what that costs: those of all inputs but the first are turned by
    /// so many degrees, and moved by as many percent of the scene's distance
    #[arg(long, alias = "pose-noise", value_name = "DEGREES", default_value = "0")]
    disturb: f64,
    /// Length in the cameras' unit that becomes the network's 1 [default: the median distance of the capture's points; without
    /// any, of what the cameras look at]
    #[arg(long, alias = "scene-scale", value_name = "LENGTH", value_parser = parse_length)]
    unit: Option<f64>,
    #[command(flatten)]
    lpips: LpipsOption,
    /// Table to write: view, psnr, ssim, nearest_psnr, mean_color_psnr, lpips, a row for each photo compared; with aligned cameras also
    /// before_psnr, before_ssim, degrees, distance, doubt
    #[arg(long, value_name = "FILE", conflicts_with = "protocol")]
    csv: Option<PathBuf>,
    /// Folder for scene.ply, in the unit of cameras that the network was given, and comparison.png: photos, what was drawn in
    /// their place, and the nearest input photos; of a protocol for its records, tables and page
    #[arg(long, short, value_name = "FOLDER", required_if_eq_any([("protocol", "dl3dv"), ("protocol", "re10k"),
        ("protocol", "mipnerf360"), ("protocol", "scannetpp")]))]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

/// How the cameras of pictures are searched for, if they are.
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
        match self.series.protocol {
            Some(protocol) => series::run(self, protocol, session),
            None => one::run(self, session),
        }
    }

    /// Checks the options that need no capture, and opens the weights.
    fn begin(&self, session: &mut Session<'_>) -> Result<(Network, Seeing)> {
        let (network, fit) = (self.weights.open_network()?, self.fit.fit);
        let size = match &network {
            Network::Tokens(checkpoint) => {
                session.notes(checkpoint.notes());
                self.quality.check(checkpoint.architecture())?;
                let size = self.quality.size_for(checkpoint);
                fit.check(size, !self.pose_free)?;
                session.notes(self.quality.doubt_size(checkpoint));
                size
            }
            Network::Pixels(checkpoint) => self.check_pixels(checkpoint)?,
        };
        self.refine.map_or(Ok(()), |steps| steps.check(self.start, &self.moved))?;
        let unused = self.theirs.given().is_none() && self.theirs.says();
        refuse("--invalid", unused, "without --scene", "with --scene")?;
        let usual = if self.series.protocol.is_some() { Filter::Bilinear } else { Filter::Lanczos };
        let filter = self.filter.unwrap_or(usual);
        let is_bilinear = self.filter == Some(Filter::Bilinear);
        refuse("--filter bilinear", is_bilinear && fit == Fit::Squares, "with --fit squares", "with --fit crop")?;
        let compared = self.score_size.unwrap_or(size);
        Ok((network, Seeing { fit, size, compared, whole: self.whole || fit == Fit::Squares, filter }))
    }

    /// How pictures' cameras are searched for.
    fn aligning(&self) -> Option<Method> {
        let usual = match self.series.protocol {
            Some(_) => Some(Method::Adam),
            None => self.pose_free.then_some(Method::LevenbergMarquardt),
        };
        self.align.map_or(usual, |Aligning(method)| method)
    }

    /// Checks the shape of the reconstruction of chosen frames.
    fn check_shape(&self, checkpoint: &Checkpoint, seeing: Seeing, choice: &Choice) -> Result<()> {
        let (Size(width, height), views) = (seeing.size, seeing.fit.count(&choice.inputs())?);
        let chosen = (self.quality.ratio, &self.quality.select);
        let shape = Shape::new(checkpoint.architecture(), views, [width, height], chosen, !self.pose_free)?;
        shape.pooled(self.quality.pool).map(drop)
    }

    /// The cameras of a folder's photos, where they are not in it.
    fn known(&self, folder: &PathBuf, session: &mut Session<'_>) -> Result<Option<Known>> {
        let Some(path) = &self.poses else { return Ok(None) };
        let photos = photos::list(session, std::slice::from_ref(folder))?;
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
}
