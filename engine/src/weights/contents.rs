//! What a file turned out to hold, and which architecture that is.

use std::collections::HashMap;
use std::path::Path;

use super::tensor::Stored;
use super::{Architecture, VARIANTS};
use crate::{Error, Result};

/// A file's tensors, by their name without `module.`, and what else it says about its network.
#[derive(Debug, Default)]
pub(super) struct Contents {
    pub tensors: HashMap<String, Stored>,
    /// Stated whole, in the metadata of our own files.
    pub architecture: Option<Architecture>,
    /// Stated in the metadata: side of the pictures it was trained with, in pixels.
    pub picture_side: Option<u32>,
    /// Stated in part, in the training configuration of a PyTorch checkpoint.
    pub conf: Conf,
}

/// The entries of a training configuration that shapes do not show.
#[derive(Debug, Default)]
pub(super) struct Conf {
    pub vit_name: Option<String>,
    pub out_layers: Option<Vec<usize>>,
    pub gaussians_per_token: Option<usize>,
    pub sh_degree: Option<usize>,
}

/// Adds a tensor under its name without the prefix of distributed training; the reason, where that cannot be.
pub(super) fn add(
    tensors: &mut HashMap<String, Stored>,
    name: &str,
    tensor: Result<Stored, String>,
) -> Result<(), String> {
    let tensor = tensor.map_err(|reason| format!("{name}: {reason}"))?;
    match tensors.insert(name.strip_prefix("module.").unwrap_or(name).to_string(), tensor) {
        Some(_) => Err(format!("{name}: found twice, with and without `module.`")),
        None => Ok(()),
    }
}

impl Contents {
    /// The architecture that the file states or, where it states none, the variant asked for or recognised.
    ///
    /// Out layers and the blocks where attention changes cannot be seen in shapes, so a variant is the base; the
    /// configuration, the position grid and the colour branch of the file override it.
    pub fn architecture(&self, path: &Path, variant: Option<&str>) -> Result<Architecture> {
        if let Some(stated) = &self.architecture {
            return match variant {
                Some(variant) if variant != stated.name => {
                    let expected = format!("{}, as {} says", stated.name, path.display());
                    Err(Error::argument("variant", variant, expected))
                }
                _ => Ok(stated.clone()),
            };
        }
        let recognised = || self.conf.vit_name.as_deref().filter(|name| VARIANTS.contains(name));
        let mut found = match variant.or_else(recognised) {
            Some(name) => Architecture::named(name)?,
            None => self.by_size(path)?,
        };
        let conf = &self.conf;
        found.out_layers = conf.out_layers.clone().unwrap_or(found.out_layers);
        found.gaussians_per_token = conf.gaussians_per_token.unwrap_or(found.gaussians_per_token);
        found.sh_degree = conf.sh_degree.unwrap_or(found.sh_degree);
        if let Some([_, positions, _]) = self.shape("backbone.backbone.pos_embed") {
            found.position_grid = positions.saturating_sub(1).isqrt();
        }
        if let Some(&[channels]) = self.shape("color_embed.proj.bias") {
            found.color_width = channels;
            found.color_heads = (channels / 64).max(1);
            found.head_hidden = found.width.saturating_add(channels).saturating_mul(2);
        }
        if let Some(&[hidden]) = self.shape("color_cross_attention.mlp.fc1.bias") {
            found.color_hidden = hidden;
        }
        found.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
        Ok(found)
    }

    fn shape(&self, name: &str) -> Option<&[usize]> {
        self.tensors.get(name).map(|tensor| tensor.shape.as_slice())
    }

    /// The variant with this file's width and number of blocks.
    fn by_size(&self, path: &Path) -> Result<Architecture> {
        let width = self.shape("backbone.backbone.norm.weight").and_then(|shape| shape.first().copied());
        let block = |i: usize| self.tensors.contains_key(&format!("backbone.backbone.blocks.{i}.norm1.weight"));
        let depth = (0..).take_while(|&i| block(i)).count();
        for variant in VARIANTS {
            let candidate = Architecture::named(variant)?;
            if Some(candidate.width) == width && candidate.depth == depth {
                return Ok(candidate);
            }
        }
        let file = path.display();
        let found = match width {
            Some(width) => format!("none, and {file} has width {width} and {depth} blocks, as no variant has"),
            None => format!("none, and {file} has no backbone"),
        };
        let expected = format!("one of {}, or a file that states its architecture", VARIANTS.join(", "));
        Err(Error::argument("variant", found, expected))
    }
}
