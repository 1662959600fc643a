use std::fmt;

use super::BlockOptions;
use crate::{
    Error, Result,
    ops::Pool,
    stages::{
        Architecture, ViewGrid,
        cluster::{ROUNDS, auto_ratio, cluster_count, even_indices, random_indices},
    },
    types::{Camera, Image, SkippedPass, poses::Capture},
};

/// Maximum views of a pass.
pub const MAX_VIEWS: usize = 192;

/// Maximum views of all passes.
pub const MAX_PHOTOS: usize = 1 << 16;

/// Maximum patches of a pass, for 32-bit indices.
pub const MAX_PATCHES: usize = 1 << 20;

const MAX_ROUNDS: usize = 100;

/// Ratio of kept tokens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ratio {
    /// In (0, 1]; 1 skips clustering.
    Fixed(f64),
    /// The paper's 0.5 sqrt(2 / views).
    Auto,
}

/// Token selection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenSelection {
    /// Tokens nearest to k-means centroids, after a number of rounds.
    Kmeans(usize),
    /// Evenly spread.
    Stride,
    /// Random, reproducible by seed.
    Random(u64),
    /// Explicit indices.
    Given(Vec<u32>),
}

impl fmt::Display for TokenSelection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Kmeans(ROUNDS) => write!(f, "kmeans"),
            Self::Kmeans(rounds) => write!(f, "kmeans:{rounds}"),
            Self::Stride => write!(f, "stride"),
            Self::Random(seed) => write!(f, "random:{seed}"),
            Self::Given(indices) => write!(f, "{} indices", indices.len()),
        }
    }
}

impl TokenSelection {
    /// The reference's rounds.
    pub const KMEANS: Self = Self::Kmeans(ROUNDS);
}

/// Reconstruction options.
#[derive(Clone, Debug)]
pub struct ReconstructOptions {
    /// Ratio of kept tokens.
    pub ratio: Ratio,
    /// Token selection.
    pub token_selection: TokenSelection,
    /// Known cameras: of the whole photos, or of the views for
    /// [`Model::reconstruct_views`](super::Model::reconstruct_views).
    pub cameras: Option<Vec<Camera>>,
    /// Length, in camera and scene units, that the network sees as 1. Training scenes have a median
    /// distance of about 1 from the first camera. By default estimated from the cameras and the
    /// capture; 1 without cameras.
    pub scene_scale: Option<f64>,
    /// Capture for the default scene scale.
    pub capture: Option<Capture>,
    /// Coordinate frame, by default the cameras' world if known.
    pub world: Option<SceneFrame>,
    /// Width and height of the network's input, multiples of the patch size, by default the trained
    /// size. Photos are cropped to its shape.
    pub input_size: Option<[u32; 2]>,
    /// Side of pooled groups, 1 to [`Pool::MAX_SIDE`]: faster and less exact with many photos.
    pub kv_pool: usize,
    /// Passes over blocks of views, if one pass does not hold all.
    pub blocks: BlockOptions,
}

impl Default for ReconstructOptions {
    fn default() -> Self {
        Self {
            ratio: Ratio::Fixed(1.0),
            token_selection: TokenSelection::KMEANS,
            cameras: None,
            scene_scale: None,
            capture: None,
            world: None,
            input_size: None,
            kv_pool: 1,
            blocks: BlockOptions::default(),
        }
    }
}

impl ReconstructOptions {
    pub(super) fn scale(&self) -> f64 {
        self.scene_scale.unwrap_or(1.0)
    }
}

/// Coordinate frame of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFrame {
    /// Camera frame of the first photo.
    FirstCamera,
    /// World of the known cameras.
    InputCameras,
}

/// Parameters of a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Views and patches.
    pub grid: ViewGrid,
    /// Number of tokens kept.
    pub tokens: usize,
    /// Their selection.
    pub kept: TokenSampling,
    /// Whether cameras are known.
    pub cameras: bool,
    /// See [`ReconstructOptions::kv_pool`].
    pub kv_pool: usize,
}

/// Kept tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TokenSampling {
    /// All, without clustering.
    All,
    /// Nearest to k-means centroids.
    Kmeans(usize),
    /// Indices from an input.
    Indices,
}

impl Shape {
    /// Returns the shape for `views` images of `[width, height]` pixels.
    pub fn new(
        architecture: &Architecture,
        views: usize,
        [width, height]: [u32; 2],
        chosen: (Ratio, &TokenSelection),
        cameras: bool,
    ) -> Result<Self> {
        let grid = grid(architecture.patch_size, views, width as usize, height as usize)?;
        if cameras && !architecture.takes_cameras() {
            return Err(Error::argument("cameras", "some", format!("none: {} knows no cameras", architecture.name)));
        }
        let (tokens, kept) = TokenSampling::of(grid, chosen)?;
        Ok(Self { grid, tokens, kept, cameras, kv_pool: 1 })
    }

    /// Sets [`ReconstructOptions::kv_pool`].
    ///
    /// # Errors
    /// [`Error::Argument`] for an invalid side.
    pub fn pooled(self, pool: usize) -> Result<Self> {
        Pool::check(pool)?;
        Ok(Self { kv_pool: pool, ..self })
    }

    /// Skipped stages, with reasons.
    pub fn skipped_passes(&self) -> Vec<SkippedPass> {
        let mut skipped_passes = Vec::new();
        match self.kept {
            TokenSampling::All => skipped_passes.push(SkippedPass::new("cluster", "every token is kept")),
            TokenSampling::Indices => {
                skipped_passes.push(SkippedPass::new("cluster", "tokens are not chosen by k-means"))
            }
            TokenSampling::Kmeans(_) => {}
        }
        if !self.cameras {
            skipped_passes.push(SkippedPass::new("camera encoder", "no cameras are given"));
        }
        if self.kv_pool > 1 {
            let why = format!("attention across views sees the means of {0} x {0} patches", self.kv_pool);
            skipped_passes.push(SkippedPass::new("keys of single patches", why));
        }
        skipped_passes
    }
}

impl TokenSampling {
    pub(crate) fn of(grid: ViewGrid, chosen: (Ratio, &TokenSelection)) -> Result<(usize, Self)> {
        let all = grid.tokens();
        if let TokenSelection::Kmeans(rounds) = chosen.1
            && !(1..=MAX_ROUNDS).contains(rounds)
        {
            return Err(Error::argument("rounds of k-means", rounds, format!("1 to {MAX_ROUNDS}")));
        }
        let tokens = match chosen {
            (_, TokenSelection::Given(indices)) => {
                if indices.is_empty() || indices.iter().any(|i| *i as usize >= all) {
                    let found = format!("{} indices", indices.len());
                    return Err(Error::argument("given tokens", found, format!("at least one, all below {all}")));
                }
                indices.len()
            }
            (wanted, _) => cluster_count(all, ratio(wanted, grid.views)?),
        };
        let kept = match chosen.1 {
            TokenSelection::Given(_) => TokenSampling::Indices,
            _ if tokens == all => TokenSampling::All,
            TokenSelection::Kmeans(rounds) => TokenSampling::Kmeans(*rounds),
            TokenSelection::Stride | TokenSelection::Random(_) => TokenSampling::Indices,
        };
        Ok((tokens, kept))
    }
}

impl TokenSelection {
    pub(crate) fn indices(&self, all: usize, tokens: usize) -> Vec<u32> {
        match self {
            Self::Kmeans(_) | Self::Stride => even_indices(all, tokens),
            Self::Random(seed) => random_indices(all, tokens, *seed),
            Self::Given(indices) => indices.clone(),
        }
    }
}

fn ratio(ratio: Ratio, views: usize) -> Result<f64> {
    match ratio {
        Ratio::Auto => Ok(auto_ratio(views)),
        Ratio::Fixed(r) if r > 0.0 && r <= 1.0 => Ok(r),
        Ratio::Fixed(r) => Err(Error::argument("ratio", r, "a number in (0, 1], or auto")),
    }
}

pub(crate) fn check_cameras(cameras: &[Camera], images: &[Image]) -> Result<()> {
    if cameras.len() != images.len() {
        return Err(Error::argument("cameras", cameras.len(), format!("{}, one a view", images.len())));
    }
    for (i, (camera, image)) in cameras.iter().zip(images).enumerate() {
        camera.validate(&format!("camera of view {i}"))?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        if size != (image.width, image.height) {
            let expected = format!("{} x {}, as the image", image.width, image.height);
            return Err(Error::argument(format!("size of camera {i}"), format!("{} x {}", size.0, size.1), expected));
        }
    }
    Ok(())
}

pub(crate) fn size_of(images: &[Image]) -> Result<[u32; 2]> {
    let size = images.first().map_or([0; 2], |first| [first.width, first.height]);
    for (i, image) in images.iter().enumerate() {
        if [image.width, image.height] != size {
            let found = format!("{} x {}", image.width, image.height);
            let expected = format!("{} x {}, as view 0", size[0], size[1]);
            return Err(Error::argument(format!("size of view {i}"), found, expected));
        }
        image.validate()?;
    }
    Ok(size)
}

pub(crate) fn grid(patch: usize, views: usize, width: usize, height: usize) -> Result<ViewGrid> {
    if !(1..=MAX_VIEWS).contains(&views) {
        return Err(Error::argument("views", views, format!("1 to {MAX_VIEWS}")));
    }
    let fail = |expected| Err(Error::argument("size of the views", format!("{width} x {height}"), expected));
    if width == 0 || height == 0 || !width.is_multiple_of(patch) || !height.is_multiple_of(patch) {
        return fail(format!("multiples of {patch}"));
    }
    let grid = ViewGrid { views, rows: height / patch, columns: width / patch, patch_size: patch };
    if grid.tokens() > MAX_PATCHES {
        return fail(format!("at most {MAX_PATCHES} patches of {patch} x {patch} in {views} views"));
    }
    Ok(grid)
}
