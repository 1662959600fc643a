//! Queries and keys on their way to attention: the norm over a head's channels, rotation by position, scale.

use super::{
    Area, Case, Mode, Worst,
    bound::{TINY, U},
    norm::{affine_errors, normed_errors},
    trial::Trial,
};
use crate::noise::Noise;
use zipsplat::{
    Result,
    gpu::{Device, Element},
    ops::{Attention, AttentionKernel, Heads, Norm, Part},
    stages::backbone::rotary_tables,
};
use zipsplat_reference::{
    backbone::rope::{global_positions, local_positions},
    ops::split_heads,
    widen,
};

const REASON: &str = "as ops/layer_norm over a head's channels; a rotation mixes two channels with a cosine and a sine that are \
    rounded once, so (|x cos| + |y sin|) times gamma_3, plus what both channels bring";

const EPS: f32 = 1e-5;

/// A projection of `views` views of `rows x columns` patches and a camera token each, whose heads are taken out.
#[derive(Clone, Copy)]
struct Problem {
    rows: usize,
    columns: usize,
    dim: usize,
    norm: bool,
    global: bool,
    /// What a random number in (-1, 1) becomes.
    value: fn(f32) -> f32,
}

impl Problem {
    fn check(&self, device: &Device) -> Result<Worst> {
        const HEADS: usize = 2;
        let Self { rows, columns, dim, .. } = *self;
        let positions = if self.global { global_positions(rows, columns) } else { local_positions(rows, columns) };
        let (tokens, width) = (positions.len(), HEADS * dim);
        let mut noise = Noise(dim as u64);
        let projection: Vec<f32> = noise.values(tokens * width).into_iter().map(self.value).collect();
        let (weight, bias) = (noise.values(dim), noise.values(dim));

        let mut trial = Trial::new(device);
        let heads = Heads { count: HEADS, dim };
        let kernel = AttentionKernel::Lanes(Element::F32);
        let shape = Attention { heads, sequences: 1, queries: tokens, keys: tokens, kernel };
        let norm = Norm { weight: trial.input(&weight), bias: trial.input(&bias), width: dim, eps: EPS };
        let table = trial.input(&rotary_tables(rows, columns, dim)[usize::from(self.global)]);
        let part = Part {
            norm: self.norm.then_some(norm),
            rotary: Some((table, tokens)),
            scale: shape.scale(),
            ..Part::default()
        };
        let input = trial.input(&projection);
        let out = trial.output::<f32>(tokens * width);
        shape.split(&mut trial.rec, (input, width), 0, tokens, part, out);
        let by_head: Vec<f32> = trial.result(out)?;
        // [heads, tokens, dim] to [tokens, heads, dim]
        let got: Vec<f32> = (0..tokens * HEADS)
            .flat_map(|i| &by_head[(i % HEADS * tokens + i / HEADS) * dim..][..dim])
            .copied()
            .collect();

        let norm = self.norm.then_some((&weight[..], &bias[..], f64::from(EPS)));
        let part = split_heads::Part { column: 0, heads: HEADS, head_dim: dim, norm, positions: None };
        let plain = split_heads::split_heads(&widen(&projection), width, part);
        let turned = split_heads::split_heads(
            &widen(&projection),
            width,
            split_heads::Part { positions: Some(&positions), ..part },
        );
        let scale = f64::from(shape.scale());
        let truth: Vec<f64> = turned.iter().map(|x| x * scale).collect();
        let mut errors = vec![0.0; plain.len()];
        if self.norm {
            let heads = widen(&projection);
            let each = heads.chunks(dim).zip(plain.chunks(dim));
            errors = each
                .flat_map(|(head, normed)| affine_errors(&normed_errors(head, f64::from(EPS)), normed, &weight, &bias))
                .collect();
        }
        let partner = |i: usize| if i % (dim / 2) < dim / 4 { i + dim / 4 } else { i - dim / 4 };
        Ok(Worst::of(&got, &truth, |i| {
            // Neither sine nor cosine is above 1.
            let carried = errors[i] + errors[partner(i)];
            let mixed = plain[i].abs() + plain[partner(i)].abs() + carried;
            scale * (carried + 5.0 * U * mixed + 2.0 * TINY) + TINY
        }))
    }
}

/// The position embedding on other grids, made on the host in f64: nothing but its rounding to f32 is left.
fn interpolation(rows: usize, columns: usize) -> Worst {
    let (side, width) = (37, 3);
    let learned = Noise(8).values((1 + side * side) * width);
    let got = zipsplat::stages::backbone::interpolate_positions(&learned, side, width, rows, columns);
    let truth = zipsplat_reference::backbone::positions::interpolate(&widen(&learned), width, rows, columns);
    // 16 products of magnitudes up to 1.6 in all, in f64.
    Worst::of(&got, &truth, |i| U * truth[i].abs() + 1e-13)
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    for (rows, columns) in [(1, 1), (1, 64), (64, 1), (18, 18), (7, 53), (37, 37), (64, 64)] {
        for (global, dim) in [(false, 64), (true, 32)] {
            let problem = Problem { rows, columns, dim, norm: true, global, value: |r| r };
            let name = format!("{rows} x {columns} patches, {}", if global { "across views" } else { "within a view" });
            cases.push(Case::new(name, rows * columns, move |device, _| problem.check(device)));
        }
    }
    let plain = Problem { rows: 3, columns: 5, dim: 64, norm: true, global: false, value: |r| r };
    let hard: [(&str, Problem); 6] = [
        ("q/k norm of zero vectors", Problem { value: |_| 0.0, ..plain }),
        ("q/k norm of equal channels", Problem { value: |_| 777.7, ..plain }),
        ("q/k norm, mean 1e4, spread 1e-2", Problem { value: |r| 1e4 + 1e-2 * r, ..plain }),
        ("q/k norm of activations of 1e4", Problem { value: |r| 1e4 * r, ..plain }),
        ("activations of 1e4 without norm", Problem { norm: false, value: |r| 1e4 * r, ..plain }),
        ("subnormal channels without norm", Problem { norm: false, value: |r| 1e-39 * r, ..plain }),
    ];
    for (name, problem) in hard {
        cases.push(Case::new(name, 15, move |device, _| problem.check(device)));
    }
    for (rows, columns) in [(1, 1), (1, 64), (18, 18), (36, 37), (37, 37), (64, 64), (64, 3)] {
        let name = format!("position embedding on {rows} x {columns}");
        cases.push(Case::new(name, rows * columns, move |_, _| Ok(interpolation(rows, columns))));
    }
    Area { kernel: "ops/split_heads", size: "patches", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
