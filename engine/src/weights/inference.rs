use std::path::Path;

use super::contents::{Conf, Contents};
use super::variant::Variant;
use super::{Architecture, Ffn, RECIPES, VARIANTS};
use crate::{
    Error, Result,
    stages::{MAX_DEPTH, MAX_SIZE},
};

const BACKBONE: &str = "backbone.backbone";
const MAX_NAME: usize = 64;

/// Facts beyond shapes come from `variant`, the training configuration, or the named network of
/// this size. All known recipes start global attention and rotary embedding with q/k norm.
pub(super) fn architecture(
    contents: &Contents,
    path: &Path,
    variant: Option<&str>,
) -> Result<(Architecture, Option<String>)> {
    let wanted = Variant::parse(variant, contents.conf.clone())?;
    let file = path.display().to_string();
    if let Some(stated) = &contents.architecture {
        wanted.check(stated, &file)?;
        return Ok((stated.clone(), None));
    }
    let shapes = Shapes(contents);
    let size = shapes.size_of_network(&file)?;
    let Variant { name: wanted, conf } = wanted;
    let like = like(wanted, &size, &file)?;

    let out_layers = conf.out_layers.as_ref().or(like.as_ref().map(|like| &like.out_layers));
    let out_layers = out_layers.ok_or_else(|| size.unknown(&file))?.clone();
    let normed = Some(size.qk_norm_start).filter(|start| *start < size.depth);
    let alt_start = conf.alt_start.or(normed).or(like.as_ref().map(|like| like.alt_start));
    let alt_start = alt_start.ok_or_else(|| size.unknown(&file))?;
    let rope_start = conf.rope_start.unwrap_or(alt_start).min(size.depth);

    let mut found = Architecture {
        qk_norm_start: size.qk_norm_start,
        rope_start,
        ..Architecture::new("custom", size.width, size.depth, alt_start, &out_layers)
    };
    shapes.fill(&mut found, &conf)?;
    found.name = name(&found, wanted, conf.vit_name.as_deref());
    found.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
    let assumed = [
        conf.out_layers.is_none().then(|| format!("out_layers {out_layers:?}")),
        conf.alt_start.is_none().then(|| format!("alt_start {alt_start}")),
        conf.rope_start.is_none().then(|| format!("rope_start {rope_start}")),
    ];
    let assumed: Vec<String> = assumed.into_iter().flatten().collect();
    let note = || format!("{file} does not say all of its architecture; assumed are {}", assumed.join(", "));
    Ok((found, (!assumed.is_empty()).then(note)))
}

struct Size {
    width: usize,
    depth: usize,
    layers: usize,
    qk_norm_start: usize,
}

impl Size {
    fn describes(&self, architecture: &Architecture) -> bool {
        (architecture.width, architecture.depth) == (self.width, self.depth)
    }

    fn unknown(&self, file: &str) -> Error {
        let Self { width, depth, layers, .. } = self;
        let found = format!("none, and {file} has width {width} and {depth} blocks with {layers} out layers");
        let named = [&VARIANTS[..], &RECIPES[..]].concat().join(", ");
        let expected = format!(
            "out_layers=A,B,.. and, where no block has q/k norm, alt_start=N, since this is none of {named}; \
             or a file that states its architecture"
        );
        Error::argument("variant", found, expected)
    }
}

fn like(wanted: Option<&str>, size: &Size, file: &str) -> Result<Option<Architecture>> {
    let all = VARIANTS.iter().chain(&RECIPES).map(|name| Architecture::named(name)).collect::<Result<Vec<_>>>()?;
    if let Some(name) = wanted {
        let named = Architecture::named(name)?;
        if !size.describes(&named) {
            let expected = format!("a network of width {} and {} blocks, as {file} has", size.width, size.depth);
            return Err(Error::argument("variant", name, expected));
        }
        // A backbone's name covers its recipes.
        if RECIPES.contains(&name) {
            return Ok(Some(named));
        }
    }
    Ok(all.into_iter().find(|like| size.describes(like) && like.out_layers.len() == size.layers))
}

fn name(found: &Architecture, wanted: Option<&str>, vit_name: Option<&str>) -> String {
    let same = |like: &Architecture| {
        let blocks = |a: &Architecture| (a.width, a.depth, a.alt_start, a.qk_norm_start, a.rope_start);
        blocks(like) == blocks(found) && like.out_layers == found.out_layers
    };
    let known = VARIANTS.iter().chain(&RECIPES).find(|name| Architecture::named(name).is_ok_and(|like| same(&like)));
    let in_words =
        |name: &&str| !name.is_empty() && name.len() <= MAX_NAME && name.chars().all(|c| c.is_ascii_graphic());
    wanted.or(known.copied()).or(vit_name.filter(in_words)).unwrap_or("custom").to_string()
}

struct Shapes<'a>(&'a Contents);

impl Shapes<'_> {
    /// Highest index plus one, so that gaps count as missing.
    fn count(&self, root: &str) -> usize {
        let number =
            |name: &String| name.strip_prefix(root)?.strip_prefix('.')?.split('.').next()?.parse::<usize>().ok();
        self.0.tensors.keys().filter_map(number).max().map_or(0, |last| last.saturating_add(1))
    }

    fn size_of_network(&self, file: &str) -> Result<Size> {
        let width =
            self.0.axis(&format!("{BACKBONE}.norm.weight"), 0).or(self.0.axis(&format!("{BACKBONE}.cls_token"), 2));
        let depth = self.count(&format!("{BACKBONE}.blocks"));
        let (Some(width), 1..) = (width, depth) else {
            let expected = "a network of ZipSplat, whose tensors begin with backbone.backbone";
            return Err(Error::argument("weights", format!("{file}, without a backbone"), expected));
        };
        if width > MAX_SIZE {
            return Err(Error::format(
                file,
                None,
                format!("found tensors of width {width}, expected at most {MAX_SIZE}"),
            ));
        }
        let normed = |i: &usize| self.0.axis(&format!("{BACKBONE}.blocks.{i}.attn.q_norm.weight"), 0).is_some();
        // Names may claim any number.
        let qk_norm_start = (0..depth.min(MAX_DEPTH)).find(normed).unwrap_or(depth);
        Ok(Size { width, depth, layers: self.count("downscale"), qk_norm_start })
    }

    fn fill(&self, found: &mut Architecture, conf: &Conf) -> Result<()> {
        let set = |field: &mut usize, name: &str, axis| *field = self.0.axis(name, axis).unwrap_or(*field);
        let heads = |field: &mut usize, width: usize, at: &str| {
            let dim = self.0.axis(&format!("{at}.attn.q_norm.weight"), 0).filter(|dim| (1..=width).contains(dim));
            *field = dim.map_or(*field, |dim| width / dim);
        };
        let (block, width) = (format!("{BACKBONE}.blocks.0"), found.width);
        heads(&mut found.heads, width, &format!("{BACKBONE}.blocks.{}", found.qk_norm_start));
        match self.0.axis(&format!("{block}.mlp.w3.weight"), 1) {
            Some(hidden) => (found.ffn, found.ffn_hidden) = (Ffn::SwiGlu, hidden),
            None => set(&mut found.ffn_hidden, &format!("{block}.mlp.fc1.bias"), 0),
        }
        set(&mut found.patch_size, &format!("{BACKBONE}.patch_embed.proj.weight"), 2);
        if let Some(positions) = self.0.axis(&format!("{BACKBONE}.pos_embed"), 1) {
            found.position_grid = positions.saturating_sub(1).isqrt();
        }
        found.camera_depth = self.count("backbone.cam_enc.trunk").max(1);
        found.camera_heads = conf.camera_heads.unwrap_or(found.camera_heads);
        set(&mut found.camera_hidden, "backbone.cam_enc.trunk.0.mlp.fc1.bias", 0);
        set(&mut found.camera_pose_hidden, "backbone.cam_enc.pose_branch.fc1.bias", 0);
        heads(&mut found.fusion_heads, width, "cross_attention.0");
        set(&mut found.fusion_hidden, "cross_attention.0.mlp.fc1.bias", 0);
        set(&mut found.color_width, "color_embed.proj.bias", 0);
        found.color_heads = (found.color_width / 64).max(1);
        heads(&mut found.color_heads, found.color_width, "color_cross_attention");
        set(&mut found.color_hidden, "color_cross_attention.mlp.fc1.bias", 0);
        found.head_hidden = width.saturating_add(found.color_width).saturating_mul(2);
        set(&mut found.head_hidden, "gaussian_head.gaussian_head.0.fc1.bias", 0);
        (found.gaussians_per_token, found.sh_degree) = self.decoded(conf.gaussians_per_token, conf.sh_degree)?;
        Ok(())
    }

    fn decoded(&self, gaussians: Option<usize>, degree: Option<usize>) -> Result<(usize, usize)> {
        let width = |degree: usize| 11 + 3 * (degree + 1).pow(2);
        let Some(values) = self.0.axis("gaussian_head.gaussian_head.1.bias", 0) else {
            return Ok((gaussians.unwrap_or(32), degree.unwrap_or(1)));
        };
        let fits = |d: &usize| {
            values.is_multiple_of(width(*d))
                && gaussians.is_none_or(|count| count.checked_mul(width(*d)) == Some(values))
        };
        let degrees: Vec<usize> = (0..=3).filter(|d| degree.is_none_or(|known| known == *d)).filter(fits).collect();
        match degrees[..] {
            [degree] => Ok((values / width(degree), degree)),
            [] => Ok((gaussians.unwrap_or(32), degree.unwrap_or(1))),
            _ => {
                let found = format!("none, and {values} values a token are Gaussians of degrees {degrees:?}");
                Err(Error::argument("sh_degree of the variant", found, "sh_degree=N as part of the variant"))
            }
        }
    }
}
