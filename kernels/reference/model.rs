use std::collections::BTreeMap;

use serde_json::Value;
use zipsplat_random::Random;

use super::ops::layer_norm::layer_norm;
use super::ops::linear::linear;

/// Intermediate results by golden key, such as `bb/block0`.
pub type Taps = BTreeMap<String, Vec<f64>>;

/// Settings that parameter shapes do not determine.
#[derive(Clone, Debug)]
pub struct Architecture {
    pub patch: usize,
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    /// First block that may be global; camera tokens enter here.
    pub alt_start: usize,
    /// First block with rotary embedding.
    pub rope_start: usize,
    /// Feature blocks, ascending.
    pub out_layers: Vec<usize>,
    pub camera_blocks: usize,
    pub camera_heads: usize,
    pub fusion_heads: usize,
    pub color_width: usize,
    pub color_heads: usize,
    /// Gaussians per token, G.
    pub gaussians: usize,
    pub sh_degree: usize,
}

impl Architecture {
    fn from_manifest(manifest: &Value) -> Architecture {
        let conf = &manifest["conf"];
        let number = |value: &Value| value.as_u64().expect("a whole number") as usize;
        let params = manifest["params"].as_object().expect("parameters");
        let width = number(&params["backbone.backbone.cls_token"][2]);
        let color_width = number(&conf["color_skip_dim"]);
        let depth = (0..).take_while(|i| params.contains_key(&format!("backbone.backbone.blocks.{i}.ls1.gamma")));
        // No checkpoint stores these.
        let (alt_start, rope_start) = match conf["vit_name"].as_str().expect("vit_name") {
            "micro" | "giant_slice" => (1, 1),
            "tiny" => (2, 2),
            "tiny_swiglu" => (3, 4),
            "vits" | "vitb" => (4, 4),
            "vitl" => (8, 8),
            "vitg" => (13, 13),
            name => panic!("vision transformer {name:?} is unknown"),
        };
        Architecture {
            patch: number(&conf["patch_size"]),
            width,
            depth: depth.count(),
            heads: width / 64,
            alt_start,
            rope_start,
            out_layers: conf["out_layers"].as_array().expect("out_layers").iter().map(number).collect(),
            camera_blocks: 4,
            camera_heads: 16,
            fusion_heads: width / 64,
            color_width,
            color_heads: (color_width / 64).max(1),
            gaussians: number(&conf["gaussians_per_token"]),
            sh_degree: number(&conf["sh_degree"]),
        }
    }
}

pub struct Model {
    pub architecture: Architecture,
    pub weights: Weights,
}

/// Shape and values of parameters by checkpoint name.
pub type Weights = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

impl Model {
    /// Generates the model of `<config>.manifest.json`; `config` seeds the weights.
    pub fn generated(config: &str, manifest: &Value) -> Model {
        let params = manifest["params"].as_object().expect("parameters");
        let weights = params.iter().map(|(name, shape)| {
            let shape: Vec<usize> = serde_json::from_value(shape.clone()).expect("a shape");
            let values = generate(config, name, &shape);
            (name.clone(), (shape, values))
        });
        Model { architecture: Architecture::from_manifest(manifest), weights: weights.collect() }
    }

    pub fn scope(&self, prefix: &str) -> Scope<'_> {
        Scope::of(&self.weights, prefix)
    }
}

#[derive(Clone)]
pub struct Scope<'a> {
    weights: &'a Weights,
    prefix: String,
}

impl<'a> Scope<'a> {
    /// Returns parameters below `prefix`.
    pub fn of(weights: &'a Weights, prefix: &str) -> Self {
        Self { weights, prefix: prefix.to_owned() }
    }

    pub fn scope(&self, name: &str) -> Scope<'a> {
        Scope::of(self.weights, &format!("{}.{name}", self.prefix))
    }

    pub fn has(&self, name: &str) -> bool {
        self.weights.contains_key(&format!("{}.{name}", self.prefix))
    }

    pub fn get(&self, name: &str) -> &'a [f32] {
        let name = format!("{}.{name}", self.prefix);
        &self.weights.get(&name).unwrap_or_else(|| panic!("no parameter {name}")).1
    }

    pub fn linear(&self, name: &str, x: &[f64]) -> Vec<f64> {
        linear(x, self.get(&format!("{name}.weight")), self.get(&format!("{name}.bias")))
    }

    pub fn layer_norm(&self, name: &str, x: &[f64], eps: f64) -> Vec<f64> {
        layer_norm(x, self.get(&format!("{name}.weight")), self.get(&format!("{name}.bias")), eps)
    }
}

/// `_eps` configs divide these by 64, so that LayerNorm epsilons matter.
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

/// Generates a parameter: splitmix64 bytes seeded by the FNV-1a hash of `config/name`, exact in
/// f32, f16 and bf16.
pub fn generate(config: &str, name: &str, shape: &[usize]) -> Vec<f32> {
    let seed = fnv1a64(format!("{config}/{name}").as_bytes());
    let bytes = (0..shape.iter().product::<usize>() as u64).map(|i| (Random::nth(seed, i) >> 56) as u32);
    let shrink = if config.ends_with("_eps") && SHRUNK.iter().any(|part| name.contains(part)) { 64.0 } else { 1.0 };
    // Odd multiples of 1/256 in (-1, 1).
    let signed = |b: u32| (2.0 * b as f32 - 255.0) / 256.0;
    let value: Box<dyn Fn(u32) -> f32> = match (name.rsplit('.').next().expect("a last part"), shape.len()) {
        ("gamma", _) => Box::new(|b| (52 + b * 204 / 256) as f32 / 256.0),
        ("weight", 1) => Box::new(|b| (64 + b / 2) as f32 / 128.0),
        ("weight", _) => {
            let amplitude = weight_amplitude(name, shape[1..].iter().product());
            Box::new(move |b| signed(b) * amplitude)
        }
        ("bias", _) => Box::new(move |b| signed(b) / 8.0),
        ("pos_embed", _) => Box::new(move |b| signed(b) / 2.0),
        ("cls_token" | "camera_token", _) => Box::new(signed),
        _ => panic!("no rule generates {name}"),
    };
    bytes.map(|b| value(b) / shrink).collect()
}

/// Largest power of two up to `sqrt(3 / fan_in)`, which keeps variance near 1; doubled in the last
/// layer, for visible Gaussians.
fn weight_amplitude(name: &str, fan_in: usize) -> f32 {
    let halvings = (0..).find(|&e| 3usize << (2 * e) >= fan_in).expect("a power of four above any size");
    let halvings = if name == "gaussian_head.gaussian_head.1.weight" { halvings - 1 } else { halvings };
    (-(halvings as f32)).exp2()
}

fn fnv1a64(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}
