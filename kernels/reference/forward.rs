//! The network with every intermediate result of the goldens.

use super::backbone::block::{EPS, Options, block};
use super::backbone::camera_encoder::{Prior, camera_tokens};
use super::backbone::camera_token::{insert_camera_tokens, learned_camera_tokens};
use super::backbone::features::{feature, prepare};
use super::backbone::{block::mlp, patchify::*, rope, tokens::embed};
use super::fuse::cross_attention::cross_attention;
use super::gaussians::activate::activate;
use super::model::{Model, Taps};
use super::ops::add::add;
use super::ops::split_heads::Keys;
use super::ops::{gather_rows::gather_rows, place_columns::join_columns};
use super::{vggt, widen};

/// Of `norm1`, `norm2` and the final `norm`.
const BACKBONE_EPS: f64 = 1e-6;

pub struct Tokens {
    /// `[views * patches, width]` per output layer, deepest first.
    pub layers: Vec<Vec<f64>>,
    /// `[views * patches, color_width]`.
    pub color: Vec<f64>,
    /// `bb/*`, `prep/*` and `color/tokens`.
    pub taps: Taps,
}

/// Computes tokens of images and known cameras.
pub fn tokens(model: &Model, images: &Images, priors: Option<&[Prior]>, keys: &Keys) -> Tokens {
    let architecture = &model.architecture;
    let mut taps = Taps::new();
    let features = backbone(model, images, priors, keys, &mut taps);
    let layers: Vec<Vec<f64>> =
        features.iter().enumerate().map(|(layer, feature)| prepare(model, feature, layer)).collect();
    for (j, (feature, layer)) in features.iter().zip(&layers).enumerate() {
        taps.insert(format!("bb/feat{j}"), feature.clone());
        taps.insert(format!("prep/layer{j}"), layer.clone());
    }
    let color = model.scope("color_embed").linear("proj", &patchify(images, architecture.patch));
    taps.insert("color/tokens".into(), color.clone());
    Tokens { layers, color, taps }
}

/// `[views * patches, 2 width]` per output layer, deepest first.
fn backbone(model: &Model, images: &Images, priors: Option<&[Prior]>, keys: &Keys, taps: &mut Taps) -> Vec<Vec<f64>> {
    let architecture = &model.architecture;
    if model.scope("backbone.aggregator").has("camera_token") {
        return vggt::features(model, images, keys, taps);
    }
    let weights = model.scope("backbone.backbone");
    let [rows, columns] = images.grid(architecture.patch);
    let token_count = 1 + rows * columns;
    let local_positions = rope::local_positions(rows, columns);
    let global_positions = rope::global_positions(rows, columns);

    let mut x = embed(&weights, images, architecture.patch, architecture.width);
    taps.insert("bb/tokens0".into(), x.clone());
    let mut local = Vec::new();
    let mut features = Vec::new();
    let mut global_blocks = 0;
    for i in 0..architecture.depth {
        if i == architecture.alt_start {
            let cameras = cameras(model, images.views, priors, taps);
            insert_camera_tokens(&mut x, token_count, &cameras, architecture.width);
            taps.insert("bb/alt_in".into(), x.clone());
        }
        let global = i >= architecture.alt_start && i % 2 == 1;
        let (sequences, pool, positions) = if global {
            let (sequences, pool) = keys.of(global_blocks, images.views, [rows, columns], 1);
            global_blocks += 1;
            (sequences, pool, &global_positions)
        } else {
            (images.views, None, &local_positions)
        };
        let options = Options {
            heads: architecture.heads,
            eps: BACKBONE_EPS,
            sequences,
            positions: (i >= architecture.rope_start).then_some(positions.as_slice()),
            pool,
        };
        x = block(&weights.scope(&format!("blocks.{i}")), &x, options);
        taps.insert(format!("bb/block{i}"), x.clone());
        if !global {
            local = x.clone();
        }
        if architecture.out_layers.contains(&i) {
            let normed = weights.layer_norm("norm", &x, BACKBONE_EPS);
            features.insert(0, feature(&local, &normed, architecture.width, token_count));
        }
    }
    features
}

/// `[views, width]`: encoded known cameras, or learned tokens.
fn cameras(model: &Model, views: usize, priors: Option<&[Prior]>, taps: &mut Taps) -> Vec<f64> {
    let Some(priors) = priors else {
        let learned = widen(model.scope("backbone.backbone").get("camera_token"));
        return learned_camera_tokens(&learned, model.architecture.width, views, 0);
    };
    let (blocks, heads) = (model.architecture.camera_blocks, model.architecture.camera_heads);
    let encoded = camera_tokens(&model.scope("backbone.cam_enc"), priors, blocks, heads);
    taps.insert("bb/cam_token".into(), encoded.clone());
    encoded
}

/// Decodes scene tokens `nearest` to `gauss [K * G, 11 + 3 (degree + 1)^2]`, with all taps.
pub fn gaussians(model: &Model, tokens: &Tokens, nearest: &[u32]) -> Taps {
    let architecture = &model.architecture;
    let (width, color_width) = (architecture.width, architecture.color_width);
    let mut taps = Taps::new();
    let mut scene = gather_rows(&tokens.layers[0], width, nearest);
    taps.insert("scene_init".into(), scene.clone());
    for (l, layer) in tokens.layers.iter().enumerate() {
        let queries = gather_rows(layer, width, nearest);
        let weights = model.scope(&format!("cross_attention.{l}"));
        let delta = cross_attention(&weights, &queries, layer, architecture.fusion_heads);
        scene = add(&scene, &delta);
        taps.insert(format!("ca{l}_delta"), delta);
        taps.insert(format!("scene_ca{l}"), scene.clone());
        let options = Options { heads: architecture.fusion_heads, eps: EPS, sequences: 1, positions: None, pool: None };
        scene = block(&model.scope(&format!("self_attention.{l}")), &scene, options);
        taps.insert(format!("scene_sa{l}"), scene.clone());
    }
    let queries = gather_rows(&tokens.color, color_width, nearest);
    let weights = model.scope("color_cross_attention");
    let delta = cross_attention(&weights, &queries, &tokens.color, architecture.color_heads);
    let color = add(&queries, &delta);
    let head = model.scope("gaussian_head.gaussian_head");
    let raw = head.linear("1", &mlp(&head.scope("0"), &join_columns(&scene, width, &color, color_width)));
    let packed = 11 + 3 * (architecture.sh_degree + 1).pow(2);
    taps.insert("gauss".into(), raw.chunks(packed).flat_map(activate).collect());
    taps.insert("color_feats".into(), color);
    taps.insert("raw".into(), raw);
    taps
}
