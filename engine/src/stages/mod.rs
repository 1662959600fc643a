mod architecture;
pub mod backbone;
pub mod cluster;
pub mod depth_loss;
pub mod fuse;
pub mod gaussians;
pub mod heads;
pub mod loss;
pub mod lpips;
pub mod render;

pub use architecture::{
    Architecture, BackboneArchitecture, CameraArchitecture, DEPTH_MODELS, DepthArchitecture, Family, RECIPES, VARIANTS,
};
pub(crate) use architecture::{MAX_DEPTH, MAX_SIZE, parameter_count};

use crate::{
    Result,
    gpu::{Element, Recorder, Resident, ResidentLayout, Tensor},
    kernels::{backbone::Patchify, loss::Value},
    ops::{Epilogue, Linear, ParameterLayout, Rows, row_chunks},
    types::Scene,
};
use backbone::{DepthBackbone, TokenBackbone};
use fuse::Fuse;
use gaussians::Gaussians;
use heads::DepthHeads;
use std::ops::Range;

pub struct Stages {
    pub backbone: TokenBackbone,
    pub fuse: Fuse,
    pub gaussians: Gaussians,
}

impl Stages {
    /// Names parameters as the reference's `state_dict`.
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        Self { backbone: TokenBackbone::new(p, a), fuse: Fuse::new(p, a), gaussians: Gaussians::new(p, a) }
    }
}

pub struct DepthStages {
    pub backbone: DepthBackbone,
    pub heads: DepthHeads,
}

impl DepthStages {
    /// Names parameters as released files.
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        Self { backbone: DepthBackbone::new(p, &a.backbone), heads: DepthHeads::new(p, a) }
    }
}

#[derive(Clone, Debug)]
pub struct DepthFeatures {
    /// Patch features, shallowest first: `[local | norm(global)]`, or `norm(x)` for single-view
    /// networks.
    pub layers: Vec<Rows>,
    /// Camera tokens `[local | global]` after the last out layer, a row per view, for multi-view
    /// networks.
    pub cameras: Option<Rows>,
}

/// Translation 3, quaternion 4, vertical and horizontal field of view.
const POSE_ENCODING: usize = 9;
const POSE_VALUES: usize = POSE_ENCODING.next_multiple_of(4);

/// Reference view, if no cameras are known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reference {
    View(usize),
    /// The view nearest to the mean: the first within a thousandth, so that rounding does not
    /// decide.
    Balanced,
}

/// `views` pictures of `rows` x `columns` patches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewGrid {
    pub views: usize,
    pub rows: usize,
    pub columns: usize,
    /// In pixels.
    pub patch_size: usize,
}

impl ViewGrid {
    pub fn patches(&self) -> usize {
        self.rows * self.columns
    }

    pub fn tokens(&self) -> usize {
        self.views * self.patches()
    }

    /// Values of all pictures, with three channels.
    pub fn values(&self) -> usize {
        3 * self.tokens() * self.patch_size * self.patch_size
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameShape {
    pub cameras: usize,
    pub width: u32,
    pub height: u32,
}

/// Gaussians, or gradients of their stored values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneTensors {
    /// `[len, 3]` world.
    pub means: Tensor,
    /// `[len, 3]` standard deviations, world.
    pub scales: Tensor,
    /// `[len, 4]` wxyz, of any length but zero.
    pub quats: Tensor,
    /// `[len]` 0 to 1.
    pub opacities: Tensor,
    /// `[len, (sh_degree + 1)^2, 3]`.
    pub sh_coeffs: Tensor,
    pub len: usize,
    /// Degree of the coefficients, without zero bands above.
    pub sh_degree: u32,
}

impl SceneTensors {
    pub const NAMES: [&str; 5] = ["means", "scales", "quats", "opacities", "sh_coeffs"];

    /// Values per Gaussian of each tensor.
    pub fn widths(sh_degree: u32) -> [usize; 5] {
        [3, 3, 4, 1, 3 * coeffs_of(sh_degree)]
    }

    /// Values per Gaussian.
    pub fn width(sh_degree: u32) -> usize {
        Self::widths(sh_degree).iter().sum()
    }

    pub fn output(rec: &mut Recorder, len: usize, sh_degree: u32) -> Self {
        let widths = Self::widths(sh_degree);
        let tensors = std::array::from_fn(|i| rec.tensor::<f32>(Self::NAMES[i], widths[i] * len));
        tensors.into_iter().for_each(|tensor| rec.output(tensor));
        Self::of(tensors, len, sh_degree)
    }

    pub fn of([means, scales, quats, opacities, sh_coeffs]: [Tensor; 5], len: usize, sh_degree: u32) -> Self {
        Self { means, scales, quats, opacities, sh_coeffs, len, sh_degree }
    }

    pub fn all(&self) -> [Tensor; 5] {
        [self.means, self.scales, self.quats, self.opacities, self.sh_coeffs]
    }

    pub fn lay_out(layout: &mut ResidentLayout, len: usize, sh_degree: u32) -> Self {
        Self::of(Self::widths(sh_degree).map(|width| layout.add::<f32>(width * len)), len, sh_degree)
    }

    /// Returns consecutive Gaussians, whose tensors must be slice-aligned.
    pub fn part(&self, gaussians: Range<usize>) -> Self {
        let (widths, all, len) = (Self::widths(self.sh_degree), self.all(), gaussians.len());
        let part = |i: usize| all[i].slice::<f32>(widths[i] * gaussians.start, widths[i] * len);
        Self::of(std::array::from_fn(part), len, self.sh_degree)
    }

    pub fn write(&self, memory: &Resident, scene: &Scene) -> Result<()> {
        memory.write(self.means, &scene.means)?;
        memory.write(self.scales, &scene.scales)?;
        memory.write(self.quats, &scene.quats)?;
        memory.write(self.opacities, &scene.opacities)?;
        memory.write(self.sh_coeffs, &scene.sh_coeffs)
    }

    pub fn read(&self, memory: &Resident) -> Result<Scene> {
        Ok(Scene {
            means: memory.read(self.means)?,
            scales: memory.read(self.scales)?,
            quats: memory.read(self.quats)?,
            opacities: memory.read(self.opacities)?,
            sh_coeffs: memory.read(self.sh_coeffs)?,
            sh_degree: self.sh_degree,
            antialiased: false,
        })
    }
}

fn coeffs_of(degree: u32) -> usize {
    (degree as usize + 1).pow(2)
}

/// `normalized` applies ImageNet's means and deviations.
fn embed_patches(rec: &mut Recorder, images: Tensor, grid: ViewGrid, linear: &Linear, normalized: bool) -> Rows {
    let (view, patches) = (3 * grid.patch_size * grid.patch_size * grid.patches(), grid.patches());
    let out = Rows::scratch(rec, "embedded", grid.tokens(), linear.columns, Element::F32);
    let widths = [4 * view, linear.element().bytes() * patches * linear.inner, patches * out.row_bytes()];
    for part in row_chunks(rec, grid.views, &widths) {
        let rows = Rows::scratch(rec, "patches", part.len() * patches, linear.inner, linear.element());
        let kernel = Patchify {
            images: images.slice::<f32>(part.start * view, part.len() * view),
            out: rows.tensor,
            rows: rows.count as u32,
            height: (grid.rows * grid.patch_size) as u32,
            width: (grid.columns * grid.patch_size) as u32,
            stride: rows.width as u32,
            patch: grid.patch_size as u32,
            normalized,
            output: rows.element,
        };
        rec.dispatch_groups(kernel, rows.count);
        linear.record(rec, rows, out.part(part.start * patches..part.end * patches), Epilogue::default());
    }
    out
}

/// Pixels of an invocation in sums per camera.
pub(crate) const PIXELS_PER_RUN: usize = 8;

/// Consecutive cameras whose pictures fit a binding.
#[derive(Clone, Copy)]
pub(crate) struct CameraPart {
    pub first: u32,
    pub cameras: u32,
    pub pixels: u32,
    /// Sums per camera.
    pub groups: u32,
}

impl CameraPart {
    /// Returns the part's pictures `[cameras, pixels, channels]`.
    pub fn of(self, pictures: Tensor, channels: usize) -> Tensor {
        let width = channels * self.pixels as usize;
        pictures.slice::<f32>(width * self.first as usize, width * self.cameras as usize)
    }
}

/// Returns the parts of pictures of these numbers of channels.
pub(crate) fn camera_parts(
    rec: &Recorder,
    shape: FrameShape,
    channels: &[usize],
) -> impl Iterator<Item = CameraPart> + use<> {
    let pixels = shape.pixels();
    let groups = pixels.div_ceil(PIXELS_PER_RUN * rec.limits().subgroup_size as usize) as u32;
    let widths: Vec<usize> = channels.iter().map(|channels| size_of::<f32>() * channels * pixels).collect();
    row_chunks(rec, shape.cameras, &widths).map(move |cameras| {
        let [first, cameras] = [cameras.start as u32, cameras.len() as u32];
        CameraPart { first, cameras, pixels: pixels as u32, groups }
    })
}

/// Records `totals` `[cameras, width]`. `record` writes sums of a part, `[cameras, width, groups]`.
pub(crate) fn record_camera_sums(
    rec: &mut Recorder,
    shape: FrameShape,
    channels: &[usize],
    totals: Tensor,
    width: usize,
    record: impl Fn(&mut Recorder, CameraPart, Tensor),
) {
    for part in camera_parts(rec, shape, channels) {
        let counts = width * part.cameras as usize;
        let sums = rec.tensor::<f32>("sums", counts * part.groups as usize);
        record(rec, part, sums);
        let kernel = Value { sums, values: totals, first: width as u32 * part.first, count: part.groups, scale: 1.0 };
        rec.dispatch_groups(kernel, counts);
    }
}
