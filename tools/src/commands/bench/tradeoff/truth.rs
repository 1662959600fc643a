//! Deviation of a reconstruction from f64, by stage.
//!
//! All precisions use the first one's tokens: rounding may flip k-means ties.

use crate::capture::ViewSplit;
use std::{collections::HashMap, ops::Range};
use zipsplat::{
    Result,
    gpu::{Run, Tensor},
    reconstruct::{KvPool, Model, ReconstructOptions, Tensors, TokenSelection},
    types::{Image, Scene},
    weights::Checkpoint,
};
use zipsplat_reference::{
    forward::{self, Tokens},
    model::{Model as Reference, Taps},
};
use zipsplat_verify::network;

/// Limit of an f64 reference: seconds on a CPU.
pub const MOST_FLOPS: u64 = 20_000_000_000;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// Of all output layers.
    pub backbone: f64,
    /// Scene tokens after the last block.
    pub fuse: f64,
    pub means: f64,
    pub scales: f64,
    pub quats: f64,
    pub opacities: f64,
    pub sh_coeffs: f64,
}

pub struct Compared {
    pub errors: Errors,
    pub scene: Scene,
    pub truth: Scene,
}

pub struct Truth<'a> {
    checkpoint: &'a Checkpoint,
    reference: Option<Reference>,
    /// By number of views and pooling.
    tokens: HashMap<(usize, KvPool), Tokens>,
    /// By number of views and settings.
    known: HashMap<(usize, String), KnownTokens>,
}

struct KnownTokens {
    chosen: Vec<u32>,
    taps: Taps,
}

impl<'a> Truth<'a> {
    pub fn new(checkpoint: &'a Checkpoint) -> Self {
        Self { checkpoint, reference: None, tokens: HashMap::new(), known: HashMap::new() }
    }

    /// `settings` exclude precision. Equal settings use the first call's `chosen` tokens.
    pub fn compare(
        &mut self,
        model: &Model,
        capture: &ViewSplit,
        request: &ReconstructOptions,
        settings: &str,
        chosen: Vec<u32>,
    ) -> Result<Compared> {
        let images = &capture.views.images;
        let reference = match &mut self.reference {
            Some(known) => known,
            unknown => unknown.insert(network::model(self.checkpoint)?),
        };
        let pool = request.kv_pool.for_views(images.len());
        let tokens = self.tokens.entry((images.len(), pool)).or_insert_with(|| {
            let priors =
                request.cameras.as_deref().map(|cameras| cameras.iter().map(network::prior).collect::<Vec<_>>());
            forward::tokens(reference, &network::images(images), priors.as_deref(), &network::keys(pool))
        });
        let known = self.known.entry((images.len(), settings.to_owned())).or_insert_with(|| {
            let taps = forward::gaussians(reference, tokens, &chosen);
            KnownTokens { chosen, taps }
        });
        let all = tokens.layers[0].len() / reference.architecture.width;
        let selection = if known.chosen.len() < all {
            TokenSelection::Given(known.chosen.clone())
        } else {
            request.token_selection.clone()
        };
        let (run, tensors) =
            observe(model, images, &ReconstructOptions { token_selection: selection, ..request.clone() })?;
        let read = |(name, tensor): &(String, Tensor)| Ok((name.clone(), run.read(*tensor)?));
        let taps: HashMap<String, Vec<f32>> = run.observed().iter().map(read).collect::<Result<_>>()?;
        let scene = tensors.read(&run)?;
        let packed = &known.taps["gauss"];
        let truth: Vec<f32> = packed.iter().map(|value| *value as f32).collect();
        let last = format!("scene_sa{}", tokens.layers.len() - 1);
        let found_layers: Vec<f32> =
            (0..tokens.layers.len()).flat_map(|j| &taps[&format!("prep/layer{j}")]).copied().collect();
        let width = model.architecture().gaussian_width();
        let field = |found: &[f32], columns: Range<usize>| {
            relative(found, packed.chunks(width).flat_map(|row| &row[columns.clone()]))
        };
        let errors = Errors {
            backbone: relative(&found_layers, tokens.layers.iter().flatten()),
            fuse: relative(&taps[&last], &known.taps[&last]),
            means: field(scene.means.as_flattened(), 0..3),
            scales: field(scene.scales.as_flattened(), 3..6),
            quats: field(scene.quats.as_flattened(), 6..10),
            opacities: field(&scene.opacities, 10..11),
            sh_coeffs: field(scene.sh_coeffs.as_flattened(), 11..width),
        };
        Ok(Compared { errors, truth: Scene::from_packed(&truth, scene.sh_degree)?, scene })
    }
}

pub fn observe(model: &Model, images: &[Image], request: &ReconstructOptions) -> Result<(Run, Tensors)> {
    let shape = model.shape(images, request)?;
    let (plan, tensors) = model.record(shape, true)?;
    let mut run = model.run(plan)?;
    model.write_inputs(&mut run, &tensors, shape, images, request)?;
    run.execute()?;
    Ok((run, tensors))
}

fn relative<'a>(found: &[f32], truth: impl IntoIterator<Item = &'a f64>) -> f64 {
    let (mut count, mut squares, mut apart) = (0, 0.0, 0.0);
    for (found, truth) in found.iter().zip(truth) {
        count += 1;
        squares += truth * truth;
        apart += (f64::from(*found) - truth).powi(2);
    }
    if count == found.len() { (apart / squares).sqrt() } else { f64::NAN }
}
