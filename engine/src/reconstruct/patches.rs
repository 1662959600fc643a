//! Where in the views a scene's tokens come from, and the cameras of the views that follow.

use super::{Request, Shape, network::Choice};
use crate::{
    Error, Result,
    cameras::{FoundCamera, Pair, find_cameras},
    gpu::Run,
    stages::ViewGrid,
    types::Scene,
};
use glam::{DVec2, DVec3};

/// The patch of each token of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Patches {
    grid: ViewGrid,
    /// Indices among all tokens of all views, where not all are kept.
    kept: Option<Vec<u32>>,
    /// Cameras were given.
    posed: bool,
}

impl Patches {
    /// The patches of the tokens with these indices among all of `grid`, or of all tokens.
    pub fn new(grid: ViewGrid, kept: Option<Vec<u32>>) -> Self {
        Self { grid, kept, posed: false }
    }

    /// The patches of the tokens of a run.
    pub(super) fn of(run: &Run, choice: Choice, shape: Shape, request: &Request) -> Result<Self> {
        let kept = match (choice.chosen, choice.indices) {
            (Some(chosen), _) => Some(run.read(chosen)?),
            (None, Some(_)) => Some(request.selection.indices(shape.grid.tokens(), shape.tokens)),
            (None, None) => None,
        };
        Ok(Self { posed: shape.cameras, ..Self::new(shape.grid, kept) })
    }

    /// The index of each token's patch, counted along rows, then down, then over views.
    pub fn indices(&self) -> Vec<u32> {
        self.kept.clone().unwrap_or_else(|| (0..self.grid.tokens() as u32).collect())
    }

    /// The number of tokens.
    pub fn len(&self) -> usize {
        self.kept.as_ref().map_or(self.grid.tokens(), Vec::len)
    }

    /// True where there is no token.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The view of a token, and the middle of its patch in pixels of the view.
    pub fn patch(&self, token: usize) -> (usize, DVec2) {
        let index = self.kept.as_ref().map_or(token, |kept| kept[token] as usize);
        let (view, patch) = (index / self.grid.patches(), index % self.grid.patches());
        let place = DVec2::new((patch % self.grid.columns) as f64, (patch / self.grid.columns) as f64);
        (view, (place + 0.5) * self.grid.patch as f64)
    }

    /// The pairs of each view: where the Gaussians of a token are, on the mean by opacity, and the middle of its patch. A token's
    /// Gaussians lie one after the other in `scene`.
    ///
    /// # Errors
    /// [`Error::Argument`] where the scene has not the same number of Gaussians for each token.
    pub fn pairs(&self, scene: &Scene) -> Result<Vec<Vec<Pair>>> {
        if self.is_empty() || scene.is_empty() || !scene.len().is_multiple_of(self.len()) {
            let expected = format!("so many for each of the {} tokens", self.len());
            return Err(Error::argument("Gaussians of the scene", scene.len(), expected));
        }
        let each = scene.len() / self.len();
        let mut pairs = vec![Vec::new(); self.grid.views];
        for (token, (means, opacities)) in scene.means.chunks(each).zip(scene.opacities.chunks(each)).enumerate() {
            let weighted =
                means.iter().zip(opacities).map(|(mean, weight)| (DVec3::from(mean.map(f64::from)), *weight));
            let (sum, weights) = weighted.fold((DVec3::ZERO, 0.0), |(sum, weights), (mean, weight)| {
                (sum + f64::from(weight) * mean, weights + f64::from(weight))
            });
            let (view, pixel) = self.patch(token);
            // A token that nobody sees says nothing.
            if weights > 0.0 {
                pairs[view].push(Pair { point: sum / weights, pixel });
            }
        }
        Ok(pairs)
    }

    /// The cameras of the views, of the size that the network saw, in the scene's world; each view's own error where it has none. Views
    /// share a focal length: `focal` in pixels, or what the pairs say.
    ///
    /// # Errors
    /// [`Error::Argument`] where cameras were given to the reconstruction; as [`Patches::pairs`].
    pub fn cameras(&self, scene: &Scene, focal: Option<f64>) -> Result<Vec<Result<FoundCamera>>> {
        if self.posed {
            let expected = "a scene that was reconstructed without cameras";
            return Err(Error::argument("cameras to find", "given ones", expected));
        }
        let ViewGrid { rows, columns, patch, .. } = self.grid;
        let size = [columns, rows].map(|count| (count * patch) as u32);
        // Of a patch nobody knows which of its pixels a Gaussian is of.
        Ok(find_cameras(&self.pairs(scene)?, size, focal, patch as f64))
    }
}
