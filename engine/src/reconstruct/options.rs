use super::{BlockOptions, KvPool, TokenSampling, TokenSelection};
use crate::{
    Error, Result,
    stages::{Architecture, ViewGrid, cluster::auto_ratio},
    types::{Camera, Image, SkippedPass, poses::Capture},
};

/// Maximum views of a pass.
pub const MAX_VIEWS: usize = 192;

/// Maximum views of all passes.
pub const MAX_PHOTOS: usize = 1 << 16;

/// Maximum patches of a pass, for 32-bit indices.
pub const MAX_PATCHES: usize = 1 << 20;

/// Ratio of kept tokens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ratio {
    /// In (0, 1]; 1 skips clustering.
    Fixed(f64),
    /// The paper's 0.5 sqrt(2 / views).
    Auto,
}

impl Ratio {
    pub(super) fn of(self, views: usize) -> Result<f64> {
        match self {
            Self::Auto => Ok(auto_ratio(views)),
            Self::Fixed(r) if r > 0.0 && r <= 1.0 => Ok(r),
            Self::Fixed(r) => Err(Error::argument("ratio", r, "a number in (0, 1], or auto")),
        }
    }
}

/// Reconstruction options.
#[derive(Clone, Debug)]
pub struct ReconstructOptions {
    /// Ratio of kept tokens.
    pub ratio: Ratio,
    /// Token selection.
    pub token_selection: TokenSelection,
    /// Known cameras: of whole photos, or of views for
    /// [`Model::reconstruct_views`](super::Model::reconstruct_views).
    pub cameras: Option<Vec<Camera>>,
    /// Length, in camera and scene units, that the network sees as 1: in training, about the median
    /// distance from the first camera. Estimated by default; 1 without cameras.
    pub scene_scale: Option<f64>,
    /// Capture for the default scene scale.
    pub capture: Option<Capture>,
    /// Coordinate frame, by default the cameras' world if known.
    pub world: Option<SceneFrame>,
    /// Width and height of the network's input, multiples of the patch size, by default the trained
    /// size. Photos are cropped to its shape.
    pub input_size: Option<[u32; 2]>,
    /// Keys of attention across views.
    pub kv_pool: KvPool,
    /// Blocks of views, if one pass does not hold all.
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
            kv_pool: KvPool::ALL,
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
    /// Never `Auto`.
    pub kv_pool: KvPool,
}

impl Shape {
    /// Returns the shape for `views` images of `[width, height]` pixels.
    pub fn new(
        architecture: &Architecture,
        views: usize,
        [width, height]: [u32; 2],
        ratio: Ratio,
        selection: &TokenSelection,
        cameras: bool,
    ) -> Result<Self> {
        let grid = grid(architecture.patch_size, views, width as usize, height as usize)?;
        if cameras && !architecture.takes_cameras() {
            return Err(Error::argument("cameras", "some", no_camera_encoder(&architecture.name)));
        }
        let (tokens, kept) = TokenSampling::of(grid, ratio, selection)?;
        Ok(Self { grid, tokens, kept, cameras, kv_pool: KvPool::ALL })
    }

    /// Sets [`ReconstructOptions::kv_pool`].
    pub fn pooled(self, pool: KvPool) -> Self {
        Self { kv_pool: pool.for_views(self.grid.views), ..self }
    }

    /// Skipped stages, with reasons.
    pub fn skipped_passes(&self) -> Vec<SkippedPass> {
        let mut skipped_passes = Vec::new();
        match self.kept {
            TokenSampling::All => skipped_passes.push(SkippedPass::new("cluster", "every token is kept")),
            TokenSampling::Indices => {
                skipped_passes.push(SkippedPass::new("cluster", "tokens are not chosen by their features"))
            }
            TokenSampling::Kmeans(_) | TokenSampling::MutualNearest => {}
        }
        if !self.cameras {
            skipped_passes.push(SkippedPass::new("camera encoder", "no cameras are given"));
        }
        if !self.kv_pool.is_all() {
            let why = format!("attention across views sees fewer: --kv-pool {}", self.kv_pool);
            skipped_passes.push(SkippedPass::new("keys of single patches", why));
        }
        skipped_passes
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

pub(crate) fn no_camera_encoder(network: &str) -> String {
    format!("none: {network} has no camera encoder; networks of ZipSplat and Depth Anything 3 have one")
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
