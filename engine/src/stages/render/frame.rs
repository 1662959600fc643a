//! What a caller asks for and gets.

use super::PixelLayout;

/// What to draw and how. What is not asked for is neither computed nor stored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderRequest {
    /// Colour, in front of `background`.
    pub rgb: bool,
    /// Alpha: 1 minus the transmittance that is left.
    pub alpha: bool,
    /// Depth along the camera's z axis.
    pub depth: Option<Depth>,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Whether Gaussians thinner than a pixel are made fainter by as much as the blur widens them (Mip-Splatting, Yu et
    /// al. 2024).
    pub antialiased: bool,
    /// Pixels of this layout stay on the device, made of colour and alpha, and nothing is read: for
    /// [`super::Renderer::render_to`].
    pub layout: Option<PixelLayout>,
}

impl Default for RenderRequest {
    /// Colour on black, without antialiasing.
    fn default() -> Self {
        Self { rgb: true, alpha: false, depth: None, background: [0.0; 3], antialiased: false, layout: None }
    }
}

impl RenderRequest {
    /// Floats a pixel.
    pub fn channels(&self) -> usize {
        3 * usize::from(self.rgb) + usize::from(self.alpha) + usize::from(self.depth.is_some())
    }
}

/// Kinds of depth, in world units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// The sum of depth times blending weight: 0 where nothing is.
    Accumulated,
    /// That sum over alpha: the mean depth of what is seen.
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
}

impl Frame {
    /// Takes a device frame `[height, width, channels]` apart.
    pub(super) fn from_channels(width: u32, height: u32, values: &[f32], request: &RenderRequest) -> Self {
        let channels = request.channels();
        let mut first = 0;
        let mut take = |wanted: bool, count: usize| {
            wanted.then(|| {
                let from = first;
                first += count;
                if count == channels {
                    return values.to_vec();
                }
                values.chunks_exact(channels).flat_map(|pixel| &pixel[from..from + count]).copied().collect()
            })
        };
        let (rgb, alpha, depth) = (take(request.rgb, 3), take(request.alpha, 1), take(request.depth.is_some(), 1));
        Self { width, height, rgb, alpha, depth }
    }
}
