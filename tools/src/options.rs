use crate::{
    released::{self, is_of_depth, open_whole_depth},
    session::Session,
};
use clap::{Args, ValueEnum};
use std::{fmt, fs, io::Read, path::Path, str::FromStr};
use zipsplat::{
    Error, Result,
    gpu::{Device, Limits},
    ops::{Arithmetic, Precision},
    reconstruct::{KvPool, Ratio, ReconstructOptions, Shape, TokenSelection},
    stages::cluster::auto_ratio,
    types::{Camera, Image, Scene, open_file},
    weights::{Architecture, Checkpoint, DepthCheckpoint},
};

pub const DEPTH_WEIGHTS: &str = "weights of Depth Anything 3 or VGGT";

#[derive(Args)]
pub struct Weights {
    /// Checkpoint, name in `zipsplat weights list`, or seeded:VARIANT for random weights [default:
    /// builtin, the built-in model]
    #[arg(long, value_name = "PATH|NAME|seeded:VARIANT[:KEY]")]
    weights: Option<String>,
    /// Architecture of a checkpoint that does not name its own: vitg, vitl, vitb, vits, da3s, da3b,
    /// da3l[:out_layers=5,7,11]
    #[arg(long, value_name = "V", requires = "weights")]
    variant: Option<String>,
}

impl Weights {
    pub fn open(&self) -> Result<Checkpoint> {
        match &self.weights {
            Some(weights) => open_checkpoint(weights, self.variant.as_deref(), CHECKPOINTS),
            None => Checkpoint::builtin(),
        }
    }

    pub fn open_network(&self) -> Result<Network> {
        match &self.weights {
            Some(weights) if is_of_depth(weights) => {
                refuse("--variant", self.variant.is_some(), DEPTH_WEIGHTS, "weights of ZipSplat")?;
                open_whole_depth(weights).map(Network::Pixels)
            }
            _ => self.open().map(Network::Tokens),
        }
    }

    pub fn as_arguments(&self) -> Vec<&str> {
        let named = [("--weights", &self.weights), ("--variant", &self.variant)];
        named.iter().filter_map(|(name, value)| Some([*name, value.as_deref()?])).flatten().collect()
    }

    pub fn as_input(&self) -> Vec<&str> {
        let variant = self.variant.iter().flat_map(|variant| ["--variant", variant]);
        [self.weights.as_deref().unwrap_or(BUILTIN)].into_iter().chain(variant).collect()
    }

    pub fn is_builtin(&self) -> bool {
        self.weights.as_deref().is_none_or(is_builtin)
    }
}

pub enum Network {
    Tokens(Checkpoint),
    /// Pixels become Gaussians, at estimated depth.
    Pixels(DepthCheckpoint),
}

impl Network {
    pub fn provenance(&self) -> &str {
        match self {
            Self::Tokens(checkpoint) => checkpoint.provenance(),
            Self::Pixels(checkpoint) => checkpoint.provenance(),
        }
    }
}

pub const BUILTIN: &str = "builtin";
/// Earlier spelling.
const BUILT_IN: &str = "built-in";

fn is_builtin(weights: &str) -> bool {
    [BUILTIN, BUILT_IN].contains(&weights)
}

pub const CHECKPOINTS: &str = "a checkpoint (safetensors, or PyTorch's archive)";

/// Rejects other files by their first bytes.
pub fn open_checkpoint(text: &str, variant: Option<&str>, expected: &str) -> Result<Checkpoint> {
    if is_builtin(text) {
        refuse(
            "--variant",
            variant.is_some(),
            "the model that is built in",
            "a checkpoint that does not say its network",
        )?;
        return Checkpoint::builtin();
    }
    if is_of_depth(text) {
        let found = format!("{text}, of Depth Anything 3 or VGGT");
        let expected =
            format!("{expected} of ZipSplat; reconstruct, view, eval, depth, cameras and convert take {DEPTH_WEIGHTS}");
        return Err(Error::argument("weights", found, expected));
    }
    if let Some(path) = released::find(text)? {
        return Checkpoint::open(path, variant);
    }
    let mut start = [0; 9];
    let read = open_file(text).is_ok_and(|mut file| file.read_exact(&mut start).is_ok());
    let known = !read || start.starts_with(b"PK") || start[8] == b'{';
    if !known {
        let kind = match Image::size(text) {
            Ok((width, height)) => format!("a picture of {width}x{height}"),
            Err(_) => "a file of unknown kind".into(),
        };
        return Err(Error::argument(text, kind, expected));
    }
    Checkpoint::parse(text, variant)
}

pub fn refuse(option: &str, given: bool, found: &str, expected: &str) -> Result<()> {
    if given { Err(Error::argument(option, found, format!("{expected}, which it is for"))) } else { Ok(()) }
}

pub fn refuse_all<const N: usize>(options: [(&str, bool); N], found: &str, expected: &str) -> Result<()> {
    options.into_iter().try_for_each(|(option, given)| refuse(option, given, found, expected))
}

#[derive(Args, Clone, Debug)]
pub struct Quality {
    /// Fraction of the tokens that become Gaussians, in (0, 1]; auto: 0.5 sqrt(2 / views)
    #[arg(long, value_name = "R|auto", default_value = "1", value_parser = parse_ratio)]
    pub ratio: Ratio,
    /// Selection of tokens: kmeans[:ROUNDS], mutual (nearest neighbors across views), stride,
    /// random[:SEED], or a text file of indices, whose number replaces --ratio
    #[arg(long, alias = "select", value_name = "HOW", default_value = "kmeans", value_parser = parse_selection)]
    pub token_selection: TokenSelection,
    /// Keys and values of the backbone's attention across views: S from 1 to 4 for means of SxS
    /// patches, local for the own view only, auto for a rule by the number of views; local/2 for
    /// the first block and the others; with +own and +first, the own and the first view are whole.
    /// Fewer are faster and less exact
    #[arg(long, alias = "pool", value_name = "RULE", default_value = "1")]
    pub kv_pool: KvPool,
    /// Keep only the N most visible Gaussians per token
    #[arg(long, aliases = ["max-gaussians-per-patch", "keep"], value_name = "N|all", default_value = "all")]
    max_gaussians_per_token: Keep,
    /// Network input size in pixels, multiples of 14 [default: the trained size]
    #[arg(long, value_name = "WxH")]
    pub input_size: Option<Size>,
    #[command(flatten)]
    pub arithmetic: ArithmeticOption,
}

#[derive(Args, Clone, Copy)]
pub struct Antialiasing {
    /// Whether the scene is antialiased: pictures fade Gaussians thinner than a pixel, as in
    /// Mip-Splatting [default: as its file states]
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub antialiased: Option<bool>,
}

impl Antialiasing {
    pub fn refuse(self, found: &str, expected: &str) -> Result<()> {
        refuse("--antialiased", self.antialiased.is_some(), found, expected)
    }
}

#[derive(Args)]
pub struct SceneInput {
    /// Drop Gaussians with NaN, infinite or out-of-range values, otherwise an error
    #[arg(long)]
    drop_invalid: bool,
    #[command(flatten)]
    pub antialiasing: Antialiasing,
}

impl SceneInput {
    pub fn refuse(&self, found: &str, expected: &str) -> Result<()> {
        self.refuse_dropping(found, expected)?;
        self.antialiasing.refuse(found, expected)
    }

    pub fn refuse_dropping(&self, found: &str, expected: &str) -> Result<()> {
        refuse("--drop-invalid", self.drop_invalid, found, expected)
    }

    pub fn read(&self, session: &mut Session<'_>, path: &Path) -> Result<(Scene, usize)> {
        let (mut scene, _) = session.stage("read scene", |_| Scene::open_unchecked(path))?;
        scene.antialiased = self.antialiasing.antialiased.unwrap_or(scene.antialiased);
        if !self.drop_invalid {
            let refused =
                |error| Error::format(path, None, format!("{error}; --drop-invalid leaves such Gaussians out"));
            scene.validate().map_err(refused)?;
            return Ok((scene, 0));
        }
        let (all, dropped) = (scene.len(), scene.drop_invalid()?);
        if dropped > 0 {
            let why = "left out: with values that are NaN, infinite or out of range";
            session.note(format!("{}: {dropped} of {all} Gaussians {why}", path.display()));
        }
        Ok((scene, dropped))
    }
}

#[derive(Args, Clone, Debug, Default)]
pub struct ArithmeticOption {
    /// Precision of the network
    #[arg(long, value_enum, default_value = "auto")]
    precision: PrecisionName,
}

impl Quality {
    pub fn check(&self, architecture: &Architecture) -> Result<()> {
        let all = architecture.gaussians_per_token;
        self.max_gaussians_per_token.of(all).map(drop)
    }

    /// `None` for all.
    pub fn kept(&self) -> Option<u32> {
        self.max_gaussians_per_token.0
    }

    pub fn ratio_of(&self, views: usize) -> f64 {
        match self.ratio {
            Ratio::Fixed(ratio) => ratio,
            Ratio::Auto => auto_ratio(views),
        }
    }

    pub fn side(&self) -> Option<u32> {
        self.input_size.map(|Size(width, height)| width.max(height))
    }

    pub fn prune(&self, scene: &mut Scene, architecture: &Architecture) {
        if let Some(keep) = self.kept() {
            scene.keep_most_visible(architecture.gaussians_per_token, keep as usize);
        }
    }

    pub fn shape(&self, architecture: &Architecture, views: usize, size: Size, cameras: bool) -> Result<Shape> {
        Ok(Shape::new(architecture, views, [size.0, size.1], self.ratio, &self.token_selection, cameras)?
            .pooled(self.kv_pool))
    }

    /// Without `cameras` the network estimates them.
    pub fn request(&self, cameras: Vec<Camera>, scene_scale: f64) -> ReconstructOptions {
        ReconstructOptions {
            ratio: self.ratio,
            token_selection: self.token_selection.clone(),
            cameras: Some(cameras).filter(|cameras| !cameras.is_empty()),
            scene_scale: Some(scene_scale),
            kv_pool: self.kv_pool,
            ..ReconstructOptions::default()
        }
    }

    pub fn size_for(&self, checkpoint: &Checkpoint) -> Size {
        Size::or_best(self.input_size, checkpoint)
    }

    pub fn doubt_size(&self, checkpoint: &Checkpoint) -> Option<String> {
        let trained = Size::or_best(None, checkpoint);
        let asked = self.input_size.filter(|asked| *asked != trained)?;
        Some(format!(
            "these weights were trained with pictures of {trained}: scenes from {asked} are likely to be worse"
        ))
    }
}

#[derive(Clone, Copy, Debug, Default, ValueEnum)]
pub enum PrecisionName {
    /// fp16 on GPUs with matrix units, else fp32
    #[default]
    #[value(alias = "best")]
    Auto,
    /// f32 throughout
    #[value(alias = "exact")]
    Fp32,
    /// f16 factors of matrix products, otherwise f32
    #[value(alias = "fast")]
    Fp16,
    /// bf16 factors of matrix products, otherwise f32
    #[value(alias = "fast-bf16")]
    Bf16,
    /// Like fp16, with 8-bit factors in the linear layers of blocks
    #[value(alias = "turbo")]
    Int8,
}

impl PrecisionName {
    pub fn precision(self) -> Option<Precision> {
        match self {
            Self::Auto => None,
            Self::Fp32 => Some(Precision::Fp32),
            Self::Fp16 => Some(Precision::Fp16),
            Self::Bf16 => Some(Precision::Bf16),
            Self::Int8 => Some(Precision::Int8),
        }
    }
}

impl ArithmeticOption {
    pub fn choose(&self, session: &mut Session<'_>, device: &Device) -> Result<(Precision, Arithmetic)> {
        session.choose(device, self.precision.precision())
    }

    pub fn planned(&self, limits: &Limits) -> (Precision, Arithmetic) {
        let precision = self.precision.precision().unwrap_or(Precision::best(limits));
        let arithmetic = Arithmetic::of(precision, limits);
        arithmetic.map_or((Precision::Fp32, Arithmetic::EXACT), |arithmetic| (precision, arithmetic))
    }
}

/// `None`: all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Keep(Option<u32>);

impl Keep {
    pub fn of(self, all: usize) -> Result<usize> {
        match self.0 {
            Some(keep) if keep as usize > all => {
                Err(Error::argument("--max-gaussians-per-token", keep, format!("1 to {all}, the Gaussians of a token")))
            }
            keep => Ok(keep.map_or(all, |keep| keep as usize)),
        }
    }
}

impl FromStr for Keep {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse() {
            _ if text == "all" => Ok(Self(None)),
            Ok(keep) if keep > 0 => Ok(Self(Some(keep))),
            _ => Err("expected a number above 0, or all".into()),
        }
    }
}

/// In pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size(pub u32, pub u32);

impl Size {
    pub fn or_best(asked: Option<Self>, checkpoint: &Checkpoint) -> Self {
        asked.unwrap_or(Self(checkpoint.image_size(), checkpoint.image_size()))
    }

    pub fn patches(self, side: usize) -> usize {
        (self.0 as usize / side) * (self.1 as usize / side)
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once('x').and_then(|(w, h)| Some(Self(w.parse().ok()?, h.parse().ok()?)));
        sides.ok_or_else(|| "expected WIDTHxHEIGHT in pixels, such as 252x252".into())
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.0, self.1)
    }
}

/// The engine checks the range.
pub fn parse_ratio(text: &str) -> Result<Ratio, String> {
    match text {
        "auto" => Ok(Ratio::Auto),
        number => number.parse().map(Ratio::Fixed).map_err(|_| "expected a number in (0, 1], or auto".into()),
    }
}

pub fn parse_length(text: &str) -> Result<f64, String> {
    let length = text.parse().ok().filter(|length: &f64| length.is_finite() && *length > 0.0);
    length.ok_or_else(|| "expected a number above 0".into())
}

/// Reads a file of indices, separated by white space, if `text` is no name.
pub fn parse_selection(text: &str) -> Result<TokenSelection, String> {
    text.parse().or_else(|unknown| match fs::read_to_string(text) {
        Err(_) => Err(format!("{unknown}, or a file of indices")),
        Ok(file) => {
            let indices = file.split_whitespace().map(|word| word.parse().map_err(|_| format!("{word} is no index")));
            indices.collect::<Result<_, _>>().map(TokenSelection::Given)
        }
    })
}
