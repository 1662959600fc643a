//! Depth Anything 3, from images to head outputs.

use super::backbone::block::{Options, block};
use super::backbone::camera_token::{insert_camera_tokens, learned_camera_tokens};
use super::backbone::features::feature;
use super::backbone::{patchify::Images, rope, tokens::embed};
use super::heads::convolution::convolution;
use super::heads::pixel_shuffle::transposed_convolution;
use super::heads::resize::{positions, resize};
use super::model::{Scope, Weights};
use super::ops::add::add;
use super::widen;

/// Sizes that parameter shapes do not determine.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    pub patch: usize,
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    /// First block that may be global; `depth` for single-view networks.
    pub alt_start: usize,
    /// Feature blocks, ascending.
    pub out_layers: [usize; 4],
}

/// Head outputs of a view, before exponentials.
#[derive(Clone, Debug)]
pub struct View {
    /// `[height, width, 2]` (depth, confidence) or `[height, width, 1]`.
    pub depth: Vec<f64>,
    /// `[8 rows, 8 columns, 7]`, multi-view only.
    pub rays: Option<Vec<f64>>,
    /// `[height, width]`, single-view only.
    pub sky: Option<Vec<f64>>,
    /// Center, quaternion xyzw, fields of view; multi-view only.
    pub camera: Option<Vec<f64>>,
}

const BLOCK_EPS: f64 = 1e-6;
const EPS: f64 = 1e-5;

#[derive(Clone)]
pub(crate) struct Map {
    pub values: Vec<f64>,
    pub size: [usize; 2],
    pub channels: usize,
}

/// Computes head outputs for normalized `images` without known cameras, in the frame of view
/// `reference`.
pub fn views(weights: &Weights, sizes: &Sizes, images: &Images, reference: usize) -> Vec<View> {
    let (layers, cameras) = features(weights, sizes, images, reference);
    let multi = sizes.alt_start < sizes.depth;
    let [rows, columns] = images.grid(sizes.patch);
    let full = [images.height, images.width];
    let head = Head { weights: Scope::of(weights, "model.head"), full, placed: multi, rectified: false };
    let view = |v: usize| {
        let levels = head.levels(&Map::of_view(&layers, [v, images.views], [rows, columns]));
        let up = head.up(&levels);
        let camera = &cameras[v * 2 * sizes.width..(v + 1) * 2 * sizes.width];
        View {
            depth: head.tail(&up, "scratch.output_conv2").values,
            rays: multi.then(|| head.rays(&levels)),
            sky: (!multi).then(|| head.tail(&up, "scratch.sky_output_conv2").values),
            camera: multi.then(|| decoded(&Scope::of(weights, "model.cam_dec"), camera)),
        }
    };
    (0..images.views).map(view).collect()
}

/// Computes patch features of all views, shallowest first, and camera tokens `[views, 2 width]`.
pub fn features(weights: &Weights, sizes: &Sizes, images: &Images, reference: usize) -> (Vec<Vec<f64>>, Vec<f64>) {
    let (width, multi) = (sizes.width, sizes.alt_start < sizes.depth);
    let scope = Scope::of(weights, "model.backbone.pretrained");
    let [rows, columns] = images.grid(sizes.patch);
    let count = 1 + rows * columns;
    let (local_at, global_at) = (rope::local_positions(rows, columns), rope::global_positions(rows, columns));
    let global_at = global_at.repeat(images.views);
    let mut x = embed(&scope, images, sizes.patch, width);
    let (mut local, mut features) = (Vec::new(), Vec::new());
    for i in 0..sizes.depth {
        if i == sizes.alt_start {
            let cameras = learned_camera_tokens(&widen(scope.get("camera_token")), width, images.views, reference);
            insert_camera_tokens(&mut x, count, &cameras, width);
        }
        let global = i >= sizes.alt_start && i % 2 == 1;
        let (sequences, at) = if global { (1, &global_at) } else { (images.views, &local_at) };
        let positions = (i >= sizes.alt_start).then_some(at.as_slice());
        let options = Options { heads: sizes.heads, eps: BLOCK_EPS, sequences, positions, pool: None };
        x = block(&scope.scope(&format!("blocks.{i}")), &x, options);
        if !global {
            local = x.clone();
        }
        if sizes.out_layers.contains(&i) {
            let normed = scope.layer_norm("norm", &x, EPS);
            let joined = feature(&local, &normed, width, count);
            let second_half = |row: &[f64]| row[width..].to_vec();
            features.push(if multi { joined } else { joined.chunks(2 * width).flat_map(second_half).collect() });
        }
    }
    let first = |view: usize| {
        let token = view * count * width..(view * count + 1) * width;
        [&local[token.clone()], &x[token]].concat()
    };
    (features, (0..images.views).flat_map(first).collect())
}

impl Map {
    /// Returns the part of view `v` of `views` in each layer.
    pub(crate) fn of_view(layers: &[Vec<f64>], [v, views]: [usize; 2], size: [usize; 2]) -> Vec<Map> {
        let part = |layer: &Vec<f64>| {
            let each = layer.len() / views;
            let values = layer[v * each..(v + 1) * each].to_vec();
            Map { channels: each / (size[0] * size[1]), values, size }
        };
        layers.iter().map(part).collect()
    }
}

/// Parameters, image size, whether positions are added, and whether residuals are rectified.
pub(crate) struct Head<'a> {
    pub weights: Scope<'a>,
    pub full: [usize; 2],
    pub placed: bool,
    pub rectified: bool,
}

impl Head<'_> {
    fn convolved(&self, x: &Map, name: &str, step: usize) -> Map {
        let (weight, bias) = (self.weights.get(&format!("{name}.weight")), format!("{name}.bias"));
        let inputs = |outputs: usize| weight.len() / (outputs * x.channels);
        let none;
        let bias = if self.weights.has(&bias) {
            self.weights.get(&bias)
        } else {
            none = vec![0.0; weight.len() / (9 * x.channels)];
            &none[..]
        };
        let side = inputs(bias.len()).isqrt();
        let values = convolution(&x.values, [x.size[1], x.channels], [side, step], weight, bias);
        let size = x.size.map(|length| (length + side / 2 * 2 - side) / step + 1);
        Map { values, size, channels: bias.len() }
    }

    fn placed(&self, x: &Map) -> Map {
        if !self.placed {
            return x.clone();
        }
        let aspect = self.full[1] as f64 / self.full[0] as f64;
        let [height, width] = x.size;
        Map { values: add(&x.values, &positions(aspect, [height, width, x.channels])), ..x.clone() }
    }

    pub(crate) fn levels(&self, features: &[Map]) -> Vec<Map> {
        let level = |(j, x): (usize, &Map)| {
            let mut x = x.clone();
            if self.placed {
                x.values = self.weights.layer_norm("norm", &x.values, EPS);
            }
            let x = self.placed(&self.convolved(&x, &format!("projects.{j}"), 1));
            let spread = |side: usize| {
                let layer = self.weights.scope(&format!("resize_layers.{j}"));
                let parameters = [layer.get("weight"), layer.get("bias")];
                let values = transposed_convolution(&x.values, [x.size[1], side], parameters);
                Map { values, size: x.size.map(|length| side * length), channels: parameters[1].len() }
            };
            let x = match j {
                0 => spread(4),
                1 => spread(2),
                2 => x,
                _ => self.convolved(&x, "resize_layers.3", 2),
            };
            self.convolved(&x, &format!("scratch.layer{}_rn", j + 1), 1)
        };
        features.iter().enumerate().map(level).collect()
    }

    fn fused(&self, levels: &[Map], suffix: &str) -> Map {
        let relu = |x: &Map| Map { values: x.values.iter().map(|x| x.max(0.0)).collect(), ..x.clone() };
        let unit = |x: &Map, name: &str| {
            let hidden = self.convolved(&relu(x), &format!("{name}.conv1"), 1);
            let change = self.convolved(&relu(&hidden), &format!("{name}.conv2"), 1);
            let kept = if self.rectified { relu(x) } else { x.clone() };
            Map { values: add(&kept.values, &change.values), ..change }
        };
        let mut below: Option<Map> = None;
        for j in (0..4).rev() {
            let name = format!("scratch.refinenet{}{suffix}", j + 1);
            let x = match &below {
                Some(below) => {
                    let level = unit(&levels[j], &format!("{name}.resConfUnit1"));
                    Map { values: add(&level.values, &below.values), ..level }
                }
                None => levels[j].clone(),
            };
            let x = unit(&x, &format!("{name}.resConfUnit2"));
            let size = if j > 0 { levels[j - 1].size } else { x.size.map(|length| 2 * length) };
            below = Some(self.convolved(&resized(&x, size), &format!("{name}.out_conv"), 1));
        }
        below.expect("four levels")
    }

    pub(crate) fn up(&self, levels: &[Map]) -> Map {
        let neck = self.convolved(&self.fused(levels, ""), "scratch.output_conv1", 1);
        self.placed(&resized(&neck, self.full))
    }

    pub(crate) fn tail(&self, x: &Map, name: &str) -> Map {
        let mut hidden = self.convolved(x, &format!("{name}.0"), 1);
        hidden.values.iter_mut().for_each(|x| *x = x.max(0.0));
        self.convolved(&hidden, &format!("{name}.2"), 1)
    }

    fn rays(&self, levels: &[Map]) -> Vec<f64> {
        let mut x = self.fused(levels, "_aux");
        for i in 0..5 {
            x = self.convolved(&x, &format!("scratch.output_conv1_aux.3.{i}"), 1);
        }
        let mut hidden = self.convolved(&self.placed(&x), "scratch.output_conv2_aux.3.0", 1);
        hidden.values = self.weights.layer_norm("scratch.output_conv2_aux.0.2", &hidden.values, EPS);
        hidden.values.iter_mut().for_each(|x| *x = x.max(0.0));
        self.convolved(&hidden, "scratch.output_conv2_aux.3.5", 1).values
    }
}

fn resized(x: &Map, size: [usize; 2]) -> Map {
    Map { values: resize(&x.values, [x.size[1], x.channels], size), size, channels: x.channels }
}

fn decoded(weights: &Scope, token: &[f64]) -> Vec<f64> {
    let relu = |x: Vec<f64>| x.into_iter().map(|x| x.max(0.0)).collect::<Vec<_>>();
    let hidden = relu(weights.linear("backbone.2", &relu(weights.linear("backbone.0", token))));
    let fov = relu(weights.linear("fc_fov.0", &hidden));
    [weights.linear("fc_t", &hidden), weights.linear("fc_qvec", &hidden), fov].concat()
}
