use crate::prelude::*;
use zipsplat::stages::{
    FrameShape,
    loss::{Loss, record_loss, record_mask},
};
use zipsplat_reference::loss::gradient as reference;

const REASON: &str = "running error analysis of means and variances under the window, first along rows, then along columns, each \
    relative to a value near by, of SSIM made of them, and of its derivatives under the window again";

const WIDTH: usize = 21;
/// Pixels of a line per invocation.
const RUN: usize = 8;
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
const MIDDLE: f64 = 0.5;

struct Problem {
    loss: Loss,
    frames: Vec<f32>,
    targets: Vec<f32>,
    /// Bytes by pixel, in words, if masked.
    masks: Option<Vec<u32>>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfResult,
    Reversed,
    Sum,
    /// Half of 1 - SSIM, as in some papers.
    HalfDssim,
    SwappedMix,
    NeighborPixel,
    NotMasked,
    /// Masked pixels keep the gradient that windows around them give.
    MaskedGradient,
}

/// The line is zero-padded.
fn filtered<const N: usize>(
    line: &[[Bounded; N]],
    p: usize,
    value: impl Fn([Bounded; N]) -> [Bounded; N],
) -> [Bounded; N] {
    let total: f64 = (-5i32..=5).map(|x| (-f64::from(x * x) / 4.5).exp()).sum();
    let mut sums = [Bounded::exact(0.0); N];
    for tap in 0..11 {
        let weight = Bounded::rounded((-(tap as f64 - 5.0).powi(2) / 4.5).exp() / total);
        let at = (p + tap).checked_sub(5).filter(|at| *at < line.len());
        let seen = value(at.map_or([Bounded::exact(0.0); N], |at| line[at]));
        sums = std::array::from_fn(|i| sums[i] + weight * seen[i]);
    }
    sums
}

/// Windowed means of a and d = a - b, sum of the variances of a and b, variance of d.
fn moments(line: &[[Bounded; 4]]) -> Vec<[Bounded; 4]> {
    let at = |p: usize| {
        let center = line[(p / RUN * RUN + RUN / 2).min(line.len() - 1)];
        let squared = |[a, d, variances, variance]: [Bounded; 4]| {
            let (a, d) = (a - center[0], d - center[1]);
            let b = a - d;
            [a, d, variances + a * a + b * b, variance + d * d]
        };
        let [a, d, r, q] = filtered(line, p, squared);
        let (b, none) = (a - d, Bounded::exact(0.0));
        [a + center[0], d + center[1], (r - (a * a + b * b)).max(none), (q - d * d).max(none)]
    };
    (0..line.len()).map(at).collect()
}

fn turned<T: Copy>(image: &[Vec<T>]) -> Vec<Vec<T>> {
    (0..image[0].len()).map(|x| image.iter().map(|row| row[x]).collect()).collect()
}

/// 1 - SSIM and half its derivatives by the means of a - MIDDLE, squares and squared difference.
fn dssim([a, d, variances, variance]: [Bounded; 4]) -> (Bounded, [Bounded; 3]) {
    let (one, b) = (Bounded::exact(1.0), a - d);
    let means = a * a + b * b + Bounded::rounded(C1);
    let variances = variances + Bounded::rounded(C2);
    let (u, v) = (d * d / means, variance / variances);
    let by_square = (one - u) / variances;
    let by_mean = (one - v) * (d - a * u) / means - (d - (a - Bounded::exact(MIDDLE)) * v) * by_square;
    (u + v - u * v, [by_mean, -(v * by_square), by_square])
}

impl Problem {
    fn reference(&self, loss: Loss) -> Vec<f64> {
        let (a, b) = (widen(&self.frames), widen(&self.targets));
        let of = |a: &[f64], b: &[f64]| match loss {
            Loss::L1 => reference::l1(a, b),
            Loss::Mse => reference::mse(a, b),
            Loss::Dssim => reference::dssim(a, b, WIDTH),
            Loss::L1Dssim => reference::l1_dssim(a, b, WIDTH),
        };
        let (value, gradient) = match &self.masks {
            Some(masks) => reference::masked(of, &a, &b, bytemuck::cast_slice(masks)),
            None => of(&a, &b),
        };
        [vec![value], gradient].concat()
    }

    /// Without masks, with the targets at masked pixels.
    fn shown(&self) -> Self {
        let mut frames = self.frames.clone();
        (0..frames.len()).filter(|i| self.hides(i / 3)).for_each(|i| frames[i] = self.targets[i]);
        Self { frames, targets: self.targets.clone(), masks: None, ..*self }
    }

    fn hides(&self, pixel: usize) -> bool {
        self.masks.as_ref().is_some_and(|masks| masks[pixel / 4].to_le_bytes()[pixel % 4] == 0)
    }

    fn errors(&self) -> Vec<f64> {
        let (weight, dssim_weight) = match self.loss {
            Loss::L1 | Loss::Mse => (1.0, 0.0),
            Loss::Dssim => (0.0, 1.0),
            Loss::L1Dssim => (0.8, 0.2),
        };
        let count = self.frames.len();
        let mut errors = vec![0.0; 1 + count];
        let mean = Bounded::rounded(1.0 / count as f64);
        let mut sums = [0.0; 2]; // errors, magnitudes
        for color in 0..3 {
            let (by_dssim, values) = self.color(color);
            for value in values {
                sums = [sums[0] + dssim_weight * value.error, sums[1] + dssim_weight * value.value];
            }
            for (i, by_dssim) in by_dssim.into_iter().enumerate() {
                let at = 3 * i + color;
                let [a, b] = [self.frames[at], self.targets[at]].map(Bounded::exact);
                let (d, w) = (a - b, Bounded::rounded(weight));
                let (value, gradient) = match self.loss {
                    Loss::Mse => (d * d, w * (d + d)),
                    _ => (d, w * Bounded::exact(d.value.signum() * if d.value == 0.0 { 0.0 } else { 1.0 })),
                };
                sums = [sums[0] + weight * value.error, sums[1] + weight * value.value.abs()];
                errors[1 + at] = ((gradient + Bounded::rounded(dssim_weight) * by_dssim) * mean).error;
            }
        }
        // Sums of a run, a subgroup and the image, then mean and weight.
        errors[0] = (sums[0] + gamma(2 * RUN + 128 + 8) * sums[1]) / count as f64;
        errors
    }

    /// Gradient of the summed 1 - SSIM in one color, and its terms.
    fn color(&self, color: usize) -> (Vec<Bounded>, Vec<Bounded>) {
        let pair = |i: usize| [self.frames[i], self.targets[i]].map(Bounded::exact);
        let rows: Vec<Vec<[Bounded; 4]>> = (0..self.frames.len() / (3 * WIDTH))
            .map(|y| {
                let none = Bounded::exact(0.0);
                let of = |x: usize| pair((y * WIDTH + x) * 3 + color);
                moments(&(0..WIDTH).map(|x| [of(x)[0], of(x)[0] - of(x)[1], none, none]).collect::<Vec<_>>())
            })
            .collect();
        let columns = turned(&rows).iter().map(|column| moments(column)).collect::<Vec<_>>();
        let found: Vec<Vec<(Bounded, [Bounded; 3])>> =
            turned(&columns).into_iter().map(|row| row.into_iter().map(dssim).collect()).collect();
        let partials = found.iter().map(|row| row.iter().map(|x| x.1).collect::<Vec<_>>());
        let spread: Vec<Vec<[Bounded; 3]>> =
            partials.map(|row| (0..WIDTH).map(|x| filtered(&row, x, |v| v)).collect()).collect();
        let columns = turned(&spread);
        let gradient = (0..self.frames.len() / 3).map(|i| {
            let [a, b] = pair(3 * i + color);
            let sums = filtered(&columns[i % WIDTH], i / WIDTH, |v| v);
            let half = sums[0] + (a - Bounded::exact(MIDDLE)) * sums[1] + (a - b) * sums[2];
            half + half
        });
        (gradient.collect(), found.into_iter().flatten().map(|x| x.0).collect())
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let (frames, targets) = (trial.input(&self.frames), trial.input(&self.targets));
        let height = (self.frames.len() / (3 * WIDTH)) as u32;
        let shape = FrameShape { cameras: 1, width: WIDTH as u32, height };
        let (pixels, masks) = (self.frames.len() / 3, self.masks.as_ref().map(|masks| trial.input(masks)));
        let masked = masks.map(|masks| record_mask(&mut trial.rec, frames, Some(targets), masks, pixels));
        let found = record_loss(&mut trial.rec, self.loss, masked.unwrap_or(frames), targets, shape, 3, 1.0);
        masks.map(|masks| record_mask(&mut trial.rec, found.d_frames, None, masks, pixels));
        Ok(trial.results([found.value, found.d_frames])?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let mut errors = self.shown().errors();
        (0..self.frames.len()).filter(|i| self.hides(i / 3)).for_each(|i| errors[1 + i] = 0.0);
        [self.reference(self.loss), errors]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let each = |of: &dyn Fn(usize) -> f64| (0..truth.len()).map(of).collect::<Vec<_>>();
        match fault {
            Fault::HalfResult => halves(truth),
            Fault::Reversed => each(&|i| if i > 0 { -truth[i] } else { truth[i] }),
            Fault::Sum => each(&|i| truth[i] * self.frames.len() as f64),
            Fault::HalfDssim => {
                let dssim = self.reference(Loss::Dssim);
                let weight = if self.loss == Loss::Dssim { 0.5 } else { 0.1 };
                each(&|i| truth[i] - weight * dssim[i])
            }
            Fault::SwappedMix => {
                let (l1, dssim) = (self.reference(Loss::L1), self.reference(Loss::Dssim));
                each(&|i| 0.2 * l1[i] + 0.8 * dssim[i])
            }
            Fault::NotMasked => {
                Self { masks: None, targets: self.targets.clone(), frames: self.frames.clone(), ..*self }
                    .reference(self.loss)
            }
            Fault::MaskedGradient => self.shown().reference(self.loss),
            Fault::NeighborPixel => each(&|i| if i > 0 { truth[1 + (i + 2) % self.frames.len()] } else { truth[0] }),
        }
    }
}

/// Mask bytes of four pixels per word, about 40 % masked.
fn mask_word(four: &[f32]) -> u32 {
    four.iter().rev().fold(0, |word, r| word << 8 | if *r > 0.2 { 0 } else { 255 })
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("loss", "pixels", Mode::ONLY_EXACT, REASON);
    for (loss, name) in [(Loss::L1, "L1"), (Loss::Mse, "MSE"), (Loss::Dssim, "1 - SSIM"), (Loss::L1Dssim, "the mix")] {
        let common = || Catches::from([HalfResult, Reversed, Sum, NeighborPixel]);
        let own: &[Fault] = match loss {
            Loss::Dssim => &[HalfDssim],
            Loss::L1Dssim => &[HalfDssim, SwappedMix],
            _ => &[],
        };
        let mut add = |what: &str, height: usize, catches: Catches<Fault>, value: fn(usize, f32) -> [f32; 2]| {
            let masked = what.starts_with("masks");
            let make = move || {
                let noise = Noise::new(7).values(3 * WIDTH * height).into_iter().enumerate();
                let (frames, targets) = noise.map(|(i, r)| value(i, r).into()).unzip();
                let masks = masked.then(|| Noise::new(8).values(WIDTH * height).chunks(4).map(mask_word).collect());
                Problem { loss, frames, targets, masks }
            };
            area.add(format!("{name}, {what}"), WIDTH * height, catches, make);
        };
        add("noise", 24, common().and(own), |i, r| [0.5 + 0.6 * r, 0.5 + 0.5 * (1e4 * r + i as f32).sin()]);
        add("a single row", 1, common().and(own), |i, r| [0.5 + 0.6 * r, 0.5 + 0.5 * (1e4 * r + i as f32).sin()]);
        let masks = Catches::from([HalfResult, Reversed, NotMasked]);
        let leaks: &[Fault] = if matches!(loss, Loss::Dssim | Loss::L1Dssim) { &[MaskedGradient] } else { &[] };
        add("masks", 24, masks.and(leaks), |i, r| [0.5 + 0.6 * r, 0.5 + 0.5 * (1e4 * r + i as f32).sin()]);
        let flat: fn(usize, f32) -> [f32; 2] = |i, _| if i % 63 < 30 { [0.9, 0.8] } else { [0.3, 0.4] };
        add("flat areas, whose variances cancel", 17, [Reversed, Sum].into(), flat);
    }
    area
}
