use crate::types::{Image, NEAR, Scene, SkippedPass};
use crate::{Error, Result};
use std::{num::NonZeroU32, path::Path};

/// Requested outputs and options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderOptions {
    /// Color over `background`.
    pub rgb: bool,
    /// 1 minus the remaining transmittance.
    pub alpha: bool,
    /// Depth along the camera axis.
    pub depth: Option<Depth>,
    /// Blended shortest axes, facing the camera.
    pub normals: bool,
    /// Token colors: Gaussians per token.
    pub token_group: Option<NonZeroU32>,
    /// Background; black costs nothing.
    pub background: [f32; 3],
    /// Opacity compensation for screen-space blur, by default [`Scene::antialiased`].
    pub antialiased: Option<bool>,
    /// Near plane in world units, positive, by default [`Scene::near`].
    pub near: Option<f32>,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            rgb: true,
            alpha: false,
            depth: None,
            normals: false,
            token_group: None,
            background: [0.0; 3],
            antialiased: None,
            near: None,
        }
    }
}

impl RenderOptions {
    /// Floats per pixel.
    pub fn channels(&self) -> usize {
        let triples = [self.rgb, self.normals, self.token_group.is_some()];
        let singles = [self.alpha, self.depth.is_some()];
        3 * triples.into_iter().filter(|on| *on).count() + singles.into_iter().filter(|on| *on).count()
    }

    pub(super) fn near_plane(&self) -> f32 {
        self.near.unwrap_or(NEAR)
    }

    pub(super) fn is_antialiased(&self) -> bool {
        self.antialiased.unwrap_or(false)
    }

    pub(super) fn with_defaults(self, near: f32, antialiased: bool) -> Self {
        Self { near: self.near.or(Some(near)), antialiased: self.antialiased.or(Some(antialiased)), ..self }
    }

    /// Fills in the defaults of `scene`.
    pub fn for_scene(self, scene: &Scene) -> Self {
        self.with_defaults(scene.near(), scene.antialiased)
    }

    pub(super) fn skipped_passes(&self, stored_degree: u32, used_degree: u32) -> Vec<SkippedPass> {
        let asked = [
            ("color", self.rgb),
            ("alpha", self.alpha),
            ("depth", self.depth.is_some()),
            ("normals", self.normals),
            ("token colors", self.token_group.is_some()),
            ("antialiasing", self.is_antialiased()),
        ];
        let mut skipped_passes: Vec<_> =
            asked.iter().filter(|(_, on)| !on).map(|(what, _)| SkippedPass::new(*what, "not asked for")).collect();
        if self.background == [0.0; 3] {
            skipped_passes.push(SkippedPass::new("background", "it is black"));
        }
        for degree in used_degree + 1..=Scene::MAX_SH_DEGREE {
            let why = if degree <= stored_degree { "all zero in this scene" } else { "not in this scene" };
            skipped_passes.push(SkippedPass::new(format!("spherical harmonics of band {degree}"), why));
        }
        skipped_passes
    }
}

/// Kind of depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// Depth times blending weight.
    Accumulated,
    /// Accumulated depth over alpha.
    Expected,
}

/// A row-major image with the requested outputs.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderOutput {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height, width, 3]` sRGB-encoded color, unbounded above.
    pub rgb: Option<Vec<f32>>,
    /// `[height, width]` in 0..1.
    pub alpha: Option<Vec<f32>>,
    /// `[height, width]` in world units.
    pub depth: Option<Vec<f32>>,
    /// `[height, width, 3]` world unit vectors, 0 if empty.
    pub normals: Option<Vec<f32>>,
    /// `[height, width, 3]` RGB in 0..1.
    pub token_colors: Option<Vec<f32>>,
}

impl RenderOutput {
    /// Writes the color as a PNG.
    ///
    /// # Errors
    /// [`Error::Argument`] if color was not requested; [`Error::Io`].
    pub fn save_png(&self, path: impl AsRef<Path>) -> Result<()> {
        let rgb = self.rgb.as_ref().ok_or_else(|| Error::argument("image to save", "none", "rgb in the options"))?;
        Image::from_rgb_f32(self.width, self.height, rgb)?.save_png(path)
    }

    /// Single outputs are moved, not copied.
    pub(super) fn from_channels(width: u32, height: u32, mut values: Vec<f32>, options: &RenderOptions) -> Self {
        let channels = options.channels();
        let mut first = 0;
        let mut take = |wanted: bool, count: usize| {
            wanted.then(|| {
                if count == channels {
                    return std::mem::take(&mut values);
                }
                let from = first;
                first += count;
                values.chunks_exact(channels).flat_map(|pixel| &pixel[from..from + count]).copied().collect()
            })
        };
        Self {
            width,
            height,
            rgb: take(options.rgb, 3),
            alpha: take(options.alpha, 1),
            depth: take(options.depth.is_some(), 1),
            normals: take(options.normals, 3),
            token_colors: take(options.token_group.is_some(), 3),
        }
    }
}
