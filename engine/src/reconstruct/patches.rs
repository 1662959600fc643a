use super::{ReconstructOptions, Shape, network::Choice};
use crate::{
    Error, Result,
    cameras::{CameraEstimate, Correspondence, find_cameras},
    gpu::Run,
    stages::ViewGrid,
    types::{Image, Scene},
};
use glam::{DVec2, DVec3};

/// Source patch per token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Patches {
    pub(super) grid: ViewGrid,
    /// Unless all are kept.
    pub(super) kept: Option<Vec<u32>>,
    pub(super) posed: bool,
}

/// Fraction of masked pixels that masks a patch.
const MASKED: f64 = 0.5;

/// Returns whether each patch is masked, if any of `images` has a mask.
pub(super) fn masked_patches(grid: ViewGrid, images: &[Image]) -> Option<Vec<bool>> {
    let side = grid.patch_size;
    let is_masked = |index: usize| {
        let (image, patch) = (&images[index / grid.patches()], index % grid.patches());
        let corner = (patch / grid.columns * grid.columns * side + patch % grid.columns) * side;
        let pixel = |i: usize| corner + i / side * grid.columns * side + i % side;
        let ignored = (0..side * side).filter(|i| image.ignores(pixel(*i))).count();
        ignored as f64 > MASKED * (side * side) as f64
    };
    let has_mask = images.iter().any(|image| image.mask.is_some());
    has_mask.then(|| (0..grid.tokens()).map(is_masked).collect())
}

pub(super) fn all_masked() -> Error {
    Error::argument("patches of the views", "all masked", "one or more that are not")
}

impl Patches {
    /// Patches of tokens `kept`, or all.
    pub fn new(grid: ViewGrid, kept: Option<Vec<u32>>) -> Self {
        Self { grid, kept, posed: false }
    }

    pub(super) fn of(run: &Run, choice: Choice, shape: Shape, options: &ReconstructOptions) -> Result<Self> {
        let kept = choice.selected.read(run, &options.token_selection, shape.grid.tokens(), shape.tokens)?;
        Ok(Self { posed: shape.cameras, ..Self::new(shape.grid, kept) })
    }

    /// Drops tokens of masked patches. Returns the others' numbers, if images have masks.
    pub(super) fn drop_masked(&mut self, masked: Option<&[bool]>) -> Option<Vec<usize>> {
        let (masked, all) = (masked?, self.indices());
        let tokens: Vec<usize> = (0..all.len()).filter(|token| !masked[all[*token] as usize]).collect();
        self.kept = Some(tokens.iter().map(|token| all[*token]).collect());
        Some(tokens)
    }

    /// Patch index per token.
    pub fn indices(&self) -> Vec<u32> {
        self.kept.clone().unwrap_or_else(|| (0..self.grid.tokens() as u32).collect())
    }

    /// Number of tokens.
    pub fn len(&self) -> usize {
        self.kept.as_ref().map_or(self.grid.tokens(), Vec::len)
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// View and patch center in pixels.
    pub fn patch(&self, token: usize) -> (usize, DVec2) {
        let index = self.kept.as_ref().map_or(token, |kept| kept[token] as usize);
        let (view, patch) = (index / self.grid.patches(), index % self.grid.patches());
        let place = DVec2::new((patch % self.grid.columns) as f64, (patch / self.grid.columns) as f64);
        (view, (place + 0.5) * self.grid.patch_size as f64)
    }

    /// Returns the opacity-weighted mean of each token's Gaussians, if any is visible.
    pub(super) fn means(&self, scene: &Scene) -> Result<Vec<Option<DVec3>>> {
        if self.is_empty() || scene.is_empty() || !scene.len().is_multiple_of(self.len()) {
            let expected = format!("so many for each of the {} tokens", self.len());
            return Err(Error::argument("Gaussians of the scene", scene.len(), expected));
        }
        let each = scene.len() / self.len();
        let mean = |(means, opacities): (&[[f32; 3]], &[f32])| {
            let weighted =
                means.iter().zip(opacities).map(|(mean, weight)| (DVec3::from(mean.map(f64::from)), *weight));
            let (sum, weights) = weighted.fold((DVec3::ZERO, 0.0), |(sum, weights), (mean, weight)| {
                (sum + f64::from(weight) * mean, weights + f64::from(weight))
            });
            (weights > 0.0).then(|| sum / weights)
        };
        Ok(scene.means.chunks(each).zip(scene.opacities.chunks(each)).map(mean).collect())
    }

    /// Returns pairs per view: means of tokens' Gaussians and patch centers.
    ///
    /// # Errors
    /// [`Error::Argument`] unless tokens have equally many Gaussians.
    pub fn pairs(&self, scene: &Scene) -> Result<Vec<Vec<Correspondence>>> {
        let mut pairs = vec![Vec::new(); self.grid.views];
        for (token, point) in self.means(scene)?.into_iter().enumerate() {
            let (view, pixel) = self.patch(token);
            pairs[view].extend(point.map(|point| Correspondence { point, pixel }));
        }
        Ok(pairs)
    }

    /// Estimates view cameras with a shared focal length; each view may fail.
    ///
    /// # Errors
    /// [`Error::Argument`] if cameras were known; as [`Patches::pairs`].
    pub fn cameras(&self, scene: &Scene, focal: Option<f64>) -> Result<Vec<Result<CameraEstimate>>> {
        if self.posed {
            let expected = "a scene that was reconstructed without cameras";
            return Err(Error::argument("cameras to find", "given ones", expected));
        }
        let ViewGrid { rows, columns, patch_size: patch, .. } = self.grid;
        let size = [columns, rows].map(|count| (count * patch) as u32);
        Ok(find_cameras(&self.pairs(scene)?, size, focal, patch as f64))
    }
}
