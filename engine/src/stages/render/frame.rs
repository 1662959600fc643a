//! The requests and results of a caller.

use super::PixelLayout;
use crate::types::{LeftOut, NEAR, Scene};
use std::num::NonZeroU32;

/// A request: what to draw and how. Nothing else is computed or stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderRequest {
    /// Colour, in front of `background`.
    pub rgb: bool,
    /// Alpha: 1 minus the transmittance that is left.
    pub alpha: bool,
    /// Depth along the camera's z axis.
    pub depth: Option<Depth>,
    /// Normals: the shortest axis of each Gaussian, turned towards the camera, blended as colour is.
    pub normals: bool,
    /// Colours that tell tokens apart, blended as colour is. A token has so many Gaussians, one after the other.
    pub token_group: Option<NonZeroU32>,
    /// Colour behind the scene; black costs nothing.
    pub background: [f32; 3],
    /// Whether Gaussians thinner than a pixel are made fainter by as much as the blur widens them (Mip-Splatting, Yu et
    /// al. 2024).
    pub antialiased: bool,
    /// Distance from the camera below which nothing is drawn, above 0. `None`: that of the scene, [`Scene::near`].
    pub near: Option<f32>,
    /// Pixels of this layout stay on the device, made of colour and alpha, and nothing is read: for
    /// [`super::Renderer::render_to`].
    pub layout: Option<PixelLayout>,
}

impl Default for RenderRequest {
    /// Colour on black, without antialiasing.
    fn default() -> Self {
        Self {
            rgb: true,
            alpha: false,
            depth: None,
            normals: false,
            token_group: None,
            background: [0.0; 3],
            antialiased: false,
            near: None,
            layout: None,
        }
    }
}

impl RenderRequest {
    /// Floats a pixel.
    pub fn channels(&self) -> usize {
        let triples = [self.rgb, self.normals, self.token_group.is_some()];
        let singles = [self.alpha, self.depth.is_some()];
        3 * triples.into_iter().filter(|on| *on).count() + singles.into_iter().filter(|on| *on).count()
    }

    /// The distance below which nothing is drawn, once it is known.
    pub(super) fn near_plane(&self) -> f32 {
        self.near.unwrap_or(NEAR)
    }

    /// The request with the near plane of a scene, unless it has one.
    pub(super) fn with_near(self, near: f32) -> Self {
        Self { near: self.near.or(Some(near)), ..self }
    }

    /// Effects that pictures of a scene do without; `stored_degree` of its spherical harmonics are in the scene,
    /// `used_degree` are not all zero.
    pub(super) fn left_out(&self, stored_degree: u32, used_degree: u32) -> Vec<LeftOut> {
        let asked = [
            ("color", self.rgb),
            ("alpha", self.alpha),
            ("depth", self.depth.is_some()),
            ("normals", self.normals),
            ("token colours", self.token_group.is_some()),
            ("antialiasing", self.antialiased),
        ];
        let mut left_out: Vec<_> =
            asked.iter().filter(|(_, on)| !on).map(|(what, _)| LeftOut::new(*what, "not asked for")).collect();
        if self.background == [0.0; 3] {
            left_out.push(LeftOut::new("background", "it is black"));
        }
        for degree in used_degree + 1..=Scene::MAX_SH_DEGREE {
            let why = if degree <= stored_degree { "all zero in this scene" } else { "not in this scene" };
            left_out.push(LeftOut::new(format!("spherical harmonics of band {degree}"), why));
        }
        left_out
    }
}

/// Kinds of depth, in world units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// The sum of depth times blending weight: 0 where nothing is.
    Accumulated,
    /// The accumulated sum over alpha: the mean depth of what is seen.
    Expected,
}

/// A picture, row-major. What was not asked for is `None`.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height, width, 3]` linear red, green, blue as the scene has them: not clamped above.
    pub rgb: Option<Vec<f32>>,
    /// `[height, width]` in 0..1.
    pub alpha: Option<Vec<f32>>,
    /// `[height, width]` in world units.
    pub depth: Option<Vec<f32>>,
    /// `[height, width, 3]` x, y, z in the world's frame, of length 1; 0 where nothing is.
    pub normals: Option<Vec<f32>>,
    /// `[height, width, 3]` red, green, blue in 0..1: tokens in colours of their own, on black.
    pub token_colors: Option<Vec<f32>>,
}

impl Frame {
    /// Takes a device frame `[height, width, channels]` apart. A single output is the frame itself, which is not copied: the pages
    /// of a second large picture cost more than drawing it.
    pub(super) fn from_channels(width: u32, height: u32, mut values: Vec<f32>, request: &RenderRequest) -> Self {
        let channels = request.channels();
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
            rgb: take(request.rgb, 3),
            alpha: take(request.alpha, 1),
            depth: take(request.depth.is_some(), 1),
            normals: take(request.normals, 3),
            token_colors: take(request.token_group.is_some(), 3),
        }
    }
}
