//! VGGT (Wang et al. 2025), from images to head outputs.

use super::backbone::block::{EPS, Options, block, mlp};
use super::backbone::positions::interpolate_antialiased;
use super::backbone::{patchify::*, rope, tokens::tokens};
use super::depth::{Head, Map};
use super::heads::modulate::modulate;
use super::model::{Model, Scope, Taps, Weights};
use super::ops::activation::silu;
use super::ops::add::add;
use super::ops::place_columns::join_columns;
use super::ops::split_heads::Keys;
use super::widen;

#[derive(Clone, Debug)]
pub struct Sizes {
    pub patch: usize,
    pub width: usize,
    pub heads: usize,
    /// Blocks of the patch embedding.
    pub embedding: usize,
    /// Pairs of a block within and a block across views.
    pub pairs: usize,
}

/// Special tokens per view.
pub const LEADING: usize = 5;

const EMBEDDING_EPS: f64 = 1e-6;
/// Of the norm that is modulated.
const MODULATED_EPS: f64 = 1e-6;
const ITERATIONS: usize = 4;

/// Computes the tokens after both blocks of each pair, `[views, LEADING + patches, width]`.
pub fn pairs(weights: &Scope, sizes: &Sizes, images: &Images, keys: &Keys, taps: &mut Taps) -> Vec<[Vec<f64>; 2]> {
    let [rows, columns] = images.grid(sizes.patch);
    let embedded = embed(&weights.scope("patch_embed"), sizes, images, taps);
    let special = |view: usize| {
        let kind = |name: &str| {
            let both = widen(weights.get(name));
            both[view * both.len() / 2..(view + 1) * both.len() / 2].to_vec()
        };
        [kind("camera_token"), kind("register_token")].concat()
    };
    let mut x = tokens(&embedded, images.views, [&special(0), &special(1)], 0, None);
    taps.insert("agg/tokens0".into(), x.clone());
    let mut positions = vec![[0.0; 2]; LEADING - 1];
    positions.extend(rope::local_positions(rows, columns));
    let pair = |i: usize| {
        let mut step = |kind: &str, sequences, pool| {
            let options = Options { heads: sizes.heads, eps: EPS, sequences, positions: Some(&positions), pool };
            x = block(&weights.scope(&format!("{kind}_blocks.{i}")), &x, options);
            taps.insert(format!("agg/{kind}{i}"), x.clone());
            x.clone()
        };
        let (sequences, pool) = keys.of(i, images.views, [rows, columns], LEADING);
        [step("frame", images.views, None), step("global", sequences, pool)]
    };
    (0..sizes.pairs).map(pair).collect()
}

/// Returns patches `[views, patches, width]` of DINOv2 with registers.
fn embed(weights: &Scope, sizes: &Sizes, images: &Images, taps: &mut Taps) -> Vec<f64> {
    let (width, [rows, columns]) = (sizes.width, images.grid(sizes.patch));
    let patches = weights.linear("patch_embed.proj", &patchify(&images.normalized(), sizes.patch));
    let learned = interpolate_antialiased(&widen(weights.get("pos_embed")), width, rows, columns);
    let (of_class, of_patches) = learned.split_at(width);
    let positions = [of_class, &vec![0.0; (LEADING - 1) * width], of_patches].concat();
    let special = [widen(weights.get("cls_token")), widen(weights.get("register_tokens"))].concat();
    let mut x = tokens(&patches, images.views, [&special; 2], 0, Some(&positions));
    taps.insert("pe/tokens0".into(), x.clone());
    for i in 0..sizes.embedding {
        let (heads, sequences) = (sizes.heads, images.views);
        let options = Options { heads, eps: EMBEDDING_EPS, sequences, positions: None, pool: None };
        x = block(&weights.scope(&format!("blocks.{i}")), &x, options);
        taps.insert(format!("pe/block{i}"), x.clone());
    }
    let out = patches_of(&weights.layer_norm("norm", &x, EMBEDDING_EPS), images.views, width);
    taps.insert("pe/out".into(), out.clone());
    out
}

fn patches_of(x: &[f64], views: usize, width: usize) -> Vec<f64> {
    x.chunks(x.len() / views).flat_map(|view| &view[LEADING * width..]).copied().collect()
}

/// Returns `[frame | global]` of patches, `[views * patches, 2 width]`.
pub fn feature([frame, global]: &[Vec<f64>; 2], views: usize, width: usize) -> Vec<f64> {
    join_columns(&patches_of(frame, views, width), width, &patches_of(global, views, width), width)
}

/// Returns the features of ZipSplat's decoder, deepest first.
pub fn features(model: &Model, images: &Images, keys: &Keys, taps: &mut Taps) -> Vec<Vec<f64>> {
    let a = &model.architecture;
    let (embedding, pairs_count) = (a.alt_start, (a.depth - a.alt_start) / 2);
    let sizes = Sizes { patch: a.patch, width: a.width, heads: a.heads, embedding, pairs: pairs_count };
    let all = pairs(&model.scope("backbone.aggregator"), &sizes, images, keys, taps);
    let deepest_first = a.out_layers.iter().rev();
    deepest_first.map(|block| feature(&all[(block - embedding) / 2], images.views, a.width)).collect()
}

/// Returns pose encodings `[views, 9]` by the tokens of the last pair, before ReLU: world-to-camera
/// translation, quaternion xyzw, fields of view.
pub fn cameras(
    weights: &Scope,
    [frame, global]: &[Vec<f64>; 2],
    views: usize,
    [trunk, heads]: [usize; 2],
    taps: &mut Taps,
) -> Vec<f64> {
    let width = weights.get("token_norm.bias").len();
    let first = |x: &[f64], view: usize| x[view * x.len() / views..][..width / 2].to_vec();
    let of_views = (0..views).flat_map(|view| [first(frame, view), first(global, view)].concat());
    let token = weights.layer_norm("token_norm", &of_views.collect::<Vec<_>>(), EPS);
    taps.insert("cam/tokens".into(), token.clone());
    let mut encoding: Option<Vec<f64>> = None;
    for k in 0..ITERATIONS {
        let empty = || widen(weights.get("empty_pose_tokens")).repeat(views);
        let embedded = weights.linear("embed_pose", &encoding.clone().unwrap_or_else(empty));
        let embedded: Vec<f64> = embedded.into_iter().map(silu).collect();
        let modulation = weights.linear("poseLN_modulation.1", &embedded);
        let mut x = modulate(&token, &modulation, width, MODULATED_EPS);
        taps.insert(format!("cam/modulated{k}"), x.clone());
        for i in 0..trunk {
            let options = Options { heads, eps: EPS, sequences: 1, positions: None, pool: None };
            x = block(&weights.scope(&format!("trunk.{i}")), &x, options);
        }
        taps.insert(format!("cam/trunk{k}"), x.clone());
        let delta = mlp(&weights.scope("pose_branch"), &weights.layer_norm("trunk_norm", &x, EPS));
        taps.insert(format!("cam/delta{k}"), delta.clone());
        let sum = encoding.map_or_else(|| delta.clone(), |encoding| add(&encoding, &delta));
        let rectified = |(i, x): (usize, &f64)| if i % 9 > 6 { x.max(0.0) } else { *x };
        taps.insert(format!("cam/pose_enc{k}"), sum.iter().enumerate().map(rectified).collect());
        encoding = Some(sum);
    }
    encoding.expect("iterations")
}

/// Returns the outputs of `depth_head` or `point_head` for each view, before activation: `[height,
/// width, values]`. Features are shallowest first.
pub fn dense(weights: &Weights, head: &str, features: &[Vec<f64>], images: &Images, patch: usize) -> Vec<Vec<f64>> {
    let full = [images.height, images.width];
    let head = Head { weights: Scope::of(weights, head), full, placed: true, rectified: true };
    let view = |v: usize| {
        let maps = Map::of_view(features, [v, images.views], images.grid(patch));
        head.tail(&head.up(&head.levels(&maps)), "scratch.output_conv2").values
    };
    (0..images.views).map(view).collect()
}
