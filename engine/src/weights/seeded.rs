//! Reproducible weights: splitmix64 seeded by a parameter's name hash.
//!
//! Values preserve activation scale and are exact in f32, f16 and bf16. Sources: FNV-1a (Fowler,
//! Noll, Vo); splitmix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators).

use crate::random::Random;
use rayon::prelude::*;

/// Shrunk for `_eps` keys, to expose LayerNorm epsilons.
const SHRUNK: [&str; 15] = [
    "cls_token",
    "camera_token",
    "pos_embed",
    "patch_embed.proj.",
    "color_embed.proj.",
    ".attn.qkv.",
    ".attn.q_proj.",
    ".attn.kv_proj.",
    ".attn.proj.bias",
    ".mlp.fc2.",
    "pose_branch.fc2.",
    "pre_norm_local.",
    "pre_norm_global.",
    "backbone.backbone.norm.",
    "cam_enc.token_norm.",
];

/// Those of VGGT, whose small encodings stay.
const VGGT_SHRUNK: [&str; 5] =
    ["register_token", "patch_embed.norm.", ".attn.proj.", "camera_head.token_norm.", "poseLN_modulation."];

pub(super) fn fill(key: &str, name: &str, shape: &[usize], out: &mut [f32]) {
    let seed = fnv1a64(&format!("{key}/{name}"));
    let any = |parts: &[&str]| parts.iter().any(|part| name.contains(part));
    let shrink = match name.split('.').next() {
        Some("camera_head") if name.contains("pose_branch") => false,
        Some("aggregator" | "camera_head") => any(&SHRUNK) || any(&VGGT_SHRUNK),
        _ => any(&SHRUNK),
    };
    let shrink = shrink && key.ends_with("_eps");
    let scale = if shrink { 1.0 / 64.0 } else { 1.0 };
    let values: [f32; 256] = std::array::from_fn(|byte| scale * value(byte as u8, name, shape));
    out.par_iter_mut()
        .with_min_len(4096)
        .enumerate()
        .for_each(|(i, out)| *out = values[usize::from(draw(seed, i as u64))]);
    if name == "camera_head.pose_branch.fc2.bias" {
        // Four passes add up to a view near a right angle.
        out.iter_mut().skip(7).for_each(|fov| *fov += 15.0 / 64.0);
    }
}

fn value(byte: u8, name: &str, shape: &[usize]) -> f32 {
    let integer = u32::from(byte);
    // in (-1, 1), never 0
    let centered = (2.0 * f32::from(byte) - 255.0) / 256.0;
    match name.rsplit('.').next() {
        Some("gamma") => (52 + ((integer * 204) >> 8)) as f32 / 256.0,
        Some(name) if name.ends_with("token") || name.ends_with("tokens") => centered,
        Some("pos_embed") => centered / 2.0,
        // A view near a right angle.
        Some("bias") if name.ends_with("fc_fov.0.bias") => 1.0 + centered / 8.0,
        Some("bias") => centered / 8.0,
        _ if shape.len() == 1 => (64 + integer / 2) as f32 / 128.0,
        _ => centered * matrix_scale(name, shape),
    }
}

/// Doubled, so that outputs vary.
const HEADS: [&str; 6] = [
    "gaussian_head.gaussian_head.1.weight",
    "model.head.",
    "model.gs_head.",
    "model.cam_dec.",
    "depth_head.",
    "point_head.",
];

/// Halved, so that exponentials and sums of passes stay moderate.
const HALVED: [&str; 3] = [
    "depth_head.scratch.output_conv2.2.weight",
    "point_head.scratch.output_conv2.2.weight",
    "camera_head.pose_branch.fc2.weight",
];

/// Largest power of two up to sqrt(3 / fan-in), doubled in most `HEADS`, halved in `HALVED`.
fn matrix_scale(name: &str, shape: &[usize]) -> f32 {
    // Non-overlapping: outputs sum over inputs only.
    let spread = ["resize_layers.0.weight", "resize_layers.1.weight"].iter().any(|layer| name.ends_with(layer));
    let fan_in: usize = if spread { shape[0] } else { shape.iter().skip(1).product() };
    let halvings = (0..30).find(|&e| 3usize << (2 * e) >= fan_in).unwrap_or(30);
    let head = HEADS.iter().any(|head| name.starts_with(head)) && !name.contains(".refinenet");
    let scale = match head {
        _ if HALVED.contains(&name) => 0.5,
        true => 2.0,
        false => 1.0,
    };
    scale * 0.5f32.powi(halvings)
}

fn fnv1a64(text: &str) -> u64 {
    text.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

fn draw(seed: u64, i: u64) -> u8 {
    (Random::nth(seed, i) >> 56) as u8
}
