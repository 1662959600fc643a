use crate::{
    ops::layer_norm::{self, affine_errors, normed_errors},
    prelude::*,
};
use zipsplat::{
    ops::{Attention, AttentionKernel, Heads, Norm, Part, Rotary},
    stages::backbone::{interpolate_antialiased, interpolate_positions, rotary_tables},
};
use zipsplat_reference::{
    backbone::{
        positions,
        rope::{global_positions, local_positions, rope},
    },
    ops::layer_norm::layer_norm,
};

const REASON: &str = "as ops/layer_norm over a head's channels; a rotation mixes two channels with a cosine and a sine that are \
    rounded once, so (|x cos| + |y sin|) times gamma_3, plus what both channels bring";

const EPS: f32 = 1e-5;
const HEADS: usize = 2;

/// View of `rows x columns` patches and a camera token.
#[derive(Clone, Copy)]
struct Problem {
    rows: usize,
    columns: usize,
    dim: usize,
    norm: bool,
    global: bool,
    /// Maps a random number in (-1, 1).
    value: fn(f32) -> f32,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    NoRotation,
    Backwards,
    SwappedAxes,
    NeighborPosition,
    TurnedPatches,
    NoScale,
    NoNorm,
    NoEpsilon,
    /// Variance as the difference of two f32 sums.
    OnePass,
    NeighborHead,
    Folded,
}

struct Inputs {
    projection: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Problem {
    fn inputs(&self) -> Inputs {
        let mut noise = Noise::new(self.dim as u64);
        let projection = noise.values(self.positions().len() * HEADS * self.dim).into_iter().map(self.value).collect();
        Inputs { projection, weight: noise.values(self.dim), bias: noise.values(self.dim) }
    }

    fn positions(&self) -> Vec<[f64; 2]> {
        let Self { rows, columns, .. } = *self;
        if self.global {
            // Shifted to put patches at the origin: only differences matter.
            global_positions(rows, columns).into_iter().map(|place| place.map(|step| step - 1.0)).collect()
        } else {
            local_positions(rows, columns)
        }
    }

    fn scale(&self) -> f64 {
        f64::from(1.0 / (self.dim as f32).sqrt())
    }

    fn plain(&self, inputs: &Inputs) -> Vec<f64> {
        let x = widen(&inputs.projection);
        if self.norm { layer_norm(&x, &inputs.weight, &inputs.bias, EPS.into()) } else { x }
    }

    fn turned(&self, plain: &[f64], positions: &[[f64; 2]]) -> Vec<f64> {
        rope(plain, positions, self.dim).iter().map(|x| x * self.scale()).collect()
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let Self { rows, columns, dim, .. } = *self;
        let (inputs, tokens, width) = (self.inputs(), self.positions().len(), HEADS * dim);
        let mut trial = Trial::new(device);
        let heads = Heads { count: HEADS, dim };
        let kernel = AttentionKernel::Lanes(Element::F32);
        let shape = Attention { heads, sequences: 1, queries: tokens, common_keys: 0, keys: tokens, kernel };
        let (weight, bias) = (trial.input(&inputs.weight), trial.input(&inputs.bias));
        let norm = Norm { weight, bias, width: dim, eps: EPS };
        let table = &rotary_tables(rows, columns, dim)[usize::from(self.global)];
        let part = Part {
            norm: self.norm.then_some(norm),
            rotary: Some(Rotary { table: trial.input(table), tokens, turned: table.len() / dim }),
            scale: shape.scale(),
            ..Part::default()
        };
        let input = Rows::new(trial.input(&inputs.projection), tokens, width);
        let out = trial.output::<f32>(tokens * width);
        shape.split(&mut trial.rec, input, 0, part, out);
        let by_head: Vec<f32> = trial.result(out)?;
        // [heads, tokens, dim] to [tokens, heads, dim]
        let token = |i: usize| &by_head[(i % HEADS * tokens + i / HEADS) * dim..][..dim];
        Ok((0..tokens * HEADS).flat_map(token).copied().collect())
    }

    /// `[tokens, HEADS, dim]`.
    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let (inputs, dim, scale) = (self.inputs(), self.dim, self.scale());
        let plain = self.plain(&inputs);
        let mut errors = vec![0.0; plain.len()];
        if self.norm {
            let heads = widen(&inputs.projection);
            let affine = |(head, normed): (&[f64], &[f64])| {
                affine_errors(&normed_errors(head, EPS.into()), normed, &inputs.weight, &inputs.bias)
            };
            errors = heads.chunks(dim).zip(plain.chunks(dim)).flat_map(affine).collect();
        }
        let partner = |i: usize| if i % (dim / 2) < dim / 4 { i + dim / 4 } else { i - dim / 4 };
        let bound = |i: usize| {
            let carried = errors[i] + errors[partner(i)];
            let mixed = plain[i].abs() + plain[partner(i)].abs() + carried;
            scale * (carried + 5.0 * U * mixed + 2.0 * TINY) + TINY
        };
        let bounds = (0..plain.len()).map(bound).collect();
        [self.turned(&plain, &self.positions()), bounds]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (inputs, positions) = (self.inputs(), self.positions());
        let plain = self.plain(&inputs);
        let moved = |change: &dyn Fn([f64; 2]) -> [f64; 2]| {
            self.turned(&plain, &positions.iter().map(|&at| change(at)).collect::<Vec<_>>())
        };
        let normed = |fault: layer_norm::Fault, eps| {
            let rows = fault.normed(&widen(&inputs.projection), [&inputs.weight, &inputs.bias], eps);
            self.turned(&rows, &positions)
        };
        match fault {
            Fault::NoRotation => moved(&|_| [0.0; 2]),
            Fault::Backwards => moved(&|[y, x]| [-y, -x]),
            Fault::SwappedAxes => moved(&|[y, x]| [x, y]),
            Fault::NeighborPosition => moved(&|[y, x]| [y, x + 1.0]),
            Fault::TurnedPatches => moved(&|_| [-1.0; 2]),
            Fault::NoScale => truth.iter().map(|x| x / self.scale()).collect(),
            Fault::NoNorm => self.turned(&widen(&inputs.projection), &positions),
            Fault::NoEpsilon => normed(layer_norm::Fault::NoEpsilon, 0.0),
            Fault::OnePass => normed(layer_norm::Fault::OnePass, EPS.into()),
            Fault::NeighborHead => shifted(truth, self.dim),
            Fault::Folded => {
                let groups = truth.len() / self.dim;
                let place = |i: usize| i / self.dim % GROUP_FOLD as usize % groups * self.dim + i % self.dim;
                (0..truth.len()).map(|i| truth[place(i)]).collect()
            }
        }
    }
}

/// Resampled in f64 on the host; only the f32 rounding differs.
#[derive(Clone, Copy)]
struct Embedding {
    rows: usize,
    columns: usize,
    /// As VGGT.
    antialiased: bool,
}

const SIDE: usize = 37;
const WIDTH: usize = 3;

#[derive(Clone, Copy, Debug)]
enum EmbeddingFault {
    Transposed,
    NeighborPatch,
    NotInterpolated,
}

impl Values for Embedding {
    type Fault = EmbeddingFault;

    fn compute(&self, _: &Device, _: Mode) -> Result<Vec<f32>> {
        let learned = Noise::new(8).values((1 + SIDE * SIDE) * WIDTH);
        let interpolate = if self.antialiased { interpolate_antialiased } else { interpolate_positions };
        Ok(interpolate(&learned, SIDE, WIDTH, self.rows, self.columns))
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let learned = widen(&Noise::new(8).values((1 + SIDE * SIDE) * WIDTH));
        let interpolate = if self.antialiased { positions::interpolate_antialiased } else { positions::interpolate };
        let truth = interpolate(&learned, WIDTH, self.rows, self.columns);
        // f64 products with a total magnitude of at most 1.6.
        let bounds = truth.iter().map(|x| U * x.abs() + 1e-13).collect();
        [truth, bounds]
    }

    fn faulty(&self, truth: &[f64], fault: EmbeddingFault) -> Vec<f64> {
        let learned = widen(&Noise::new(8).values((1 + SIDE * SIDE) * WIDTH));
        let patch = |place: usize| &truth[place * WIDTH..][..WIDTH];
        let patches = self.rows * self.columns;
        let of = |place: &dyn Fn(usize) -> usize| -> Vec<f64> {
            (0..=patches).flat_map(|i| patch(if i == 0 { 0 } else { 1 + place(i - 1) })).copied().collect()
        };
        match fault {
            EmbeddingFault::Transposed => of(&|i| i % self.rows * self.columns + i / self.rows),
            EmbeddingFault::NeighborPatch => of(&|i| (i + 1) % patches),
            EmbeddingFault::NotInterpolated => {
                let place =
                    |i: usize| i / self.columns * SIDE / self.rows * SIDE + i % self.columns * SIDE / self.columns;
                let all = (0..=patches).map(|i| if i == 0 { 0 } else { 1 + place(i - 1) });
                all.flat_map(|place| learned[place * WIDTH..][..WIDTH].to_vec()).collect()
            }
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("ops/split_heads", "patches", Mode::ONLY_EXACT, REASON);
    for (rows, columns) in [(1, 1), (1, 64), (64, 1), (18, 18), (7, 53), (37, 37), (64, 64), (129, 129)] {
        for (global, dim) in [(false, 64), (true, 32)] {
            let problem = Problem { rows, columns, dim, norm: true, global, value: |r| r };
            let name = format!("{rows} x {columns} patches, {}", if global { "across views" } else { "within a view" });
            let turns = Catches::from([NoRotation, Backwards, NoScale, NoNorm, NeighborHead]);
            let catches = match (global, rows == columns) {
                (true, _) => turns.and(&[TurnedPatches]),
                (false, true) if rows == 1 => turns.and(&[NeighborPosition]),
                _ => turns.and(&[NeighborPosition, SwappedAxes]),
            };
            let beyond = HEADS * (1 + rows * columns) > GROUP_FOLD as usize;
            let catches = if beyond { catches.and(&[Folded]) } else { catches };
            area.add(name, rows * columns, catches, move || problem);
        }
    }
    let plain = Problem { rows: 3, columns: 5, dim: 64, norm: true, global: false, value: |r| r };
    let hard: [(&str, Fault, Problem); 6] = [
        ("q/k norm of zero vectors", NoEpsilon, Problem { value: |_| 0.0, ..plain }),
        ("q/k norm of equal channels", NoEpsilon, Problem { value: |_| 777.7, ..plain }),
        ("q/k norm, mean 1e4, spread 1e-2", OnePass, Problem { value: |r| 1e4 + 1e-2 * r, ..plain }),
        ("q/k norm of activations of 1e4", NoNorm, Problem { value: |r| 1e4 * r, ..plain }),
        ("activations of 1e4 without norm", NoScale, Problem { norm: false, value: |r| 1e4 * r, ..plain }),
        (
            "every second channel subnormal, without norm",
            NoRotation,
            Problem { norm: false, value: |r| if r > 0.0 { 1e-39 * r } else { r }, ..plain },
        ),
    ];
    for (name, fault, problem) in hard {
        area.add(name, 15, [fault], move || problem);
    }
    for (rows, columns) in [(1, 1), (1, 64), (18, 18), (36, 37), (37, 37), (64, 64), (64, 3)] {
        let name = format!("position embedding on {rows} x {columns}");
        use EmbeddingFault::*;
        let catches = Catches::from([]);
        let catches = if rows * columns > 1 { catches.and(&[NeighborPatch]) } else { catches };
        let catches = if rows > 1 && columns > 1 { catches.and(&[Transposed]) } else { catches };
        let catches = if [rows, columns] != [SIDE; 2] { catches.and(&[NotInterpolated]) } else { catches };
        let plain = Embedding { rows, columns, antialiased: false };
        area.add(format!("{name}, antialiased"), rows * columns, catches.clone(), move || Embedding {
            antialiased: true,
            ..plain
        });
        area.add(name, rows * columns, catches, move || plain);
    }
    area
}
