//! Pixel shuffle.

use crate::{
    Area, Case, Catches, Mode, Worst,
    bound::{TINY, U, half},
    case,
    noise::Noise,
    trial::Trial,
};
use zipsplat::{Result, gpu::Device, kernels::heads::PixelShuffle};
use zipsplat_reference::{heads::pixel_shuffle::pixel_shuffle, widen};

const REASON: &str = "every result is one value and one bias, whose sum rounds once";

/// Values `[height, width, side, side, channels]`.
struct Problem {
    width: usize,
    side: usize,
    values: Vec<f32>,
    bias: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    Zero,
    NoBias,
    TurnedTaps,
    InOrder,
    /// Bias of the next channel.
    NeighbourBias,
    /// 11-bit results.
    Half,
}

impl Problem {
    fn new([height, width]: [usize; 2], side: usize, channels: usize) -> Self {
        let mut noise = Noise::new((height * 31 + side * 7 + channels) as u64);
        let values = noise.values(height * width * side * side * channels);
        Self { width, side, values, bias: noise.values(channels) }
    }

    fn spread(&self, values: &[f64], bias: &[f32]) -> Vec<f64> {
        pixel_shuffle(values, [self.width, self.side], bias)
    }
}

impl case::Problem for Problem {
    type Output = Vec<f32>;
    type Truth = Vec<f64>;
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let out = trial.output::<f32>(self.values.len());
        let kernel = PixelShuffle {
            source: trial.input(&self.values),
            bias: trial.input(&self.bias),
            out,
            count: self.values.len() as u32,
            width: self.width as u32,
            side: self.side as u32,
            channels: self.bias.len() as u32,
        };
        trial.rec.dispatch(kernel, self.values.len());
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> Vec<f64> {
        self.spread(&widen(&self.values), &self.bias)
    }

    fn judge(&self, truth: &Vec<f64>, output: &Vec<f32>, _: Mode) -> Worst {
        Worst::of(output, truth, |i| U * truth[i].abs() + TINY)
    }

    fn faulty(&self, truth: &Vec<f64>, fault: Fault, _: Mode) -> Vec<Vec<f32>> {
        let (values, channels, taps) = (widen(&self.values), self.bias.len(), self.side * self.side);
        let values = match fault {
            Fault::Zero => vec![0.0; truth.len()],
            Fault::NoBias => self.spread(&values, &vec![0.0; channels]),
            Fault::TurnedTaps => {
                let turned = |i: usize| {
                    let (tap, whole) = (i / channels % taps, i - i % (channels * taps));
                    values[whole + (tap % self.side * self.side + tap / self.side) * channels + i % channels]
                };
                self.spread(&(0..values.len()).map(turned).collect::<Vec<_>>(), &self.bias)
            }
            Fault::InOrder => values.iter().enumerate().map(|(i, x)| x + f64::from(self.bias[i % channels])).collect(),
            Fault::NeighbourBias => {
                let bias: Vec<f32> = (0..channels).map(|c| self.bias[(c + 1) % channels]).collect();
                self.spread(&values, &bias)
            }
            Fault::Half => truth.iter().map(|&x| half(x)).collect(),
        };
        vec![values.into_iter().map(|x| x as f32).collect()]
    }
}

/// Sizes of every remainder.
pub fn shapes() -> Area {
    let sizes = [([3, 4], 4, 16), ([2, 5], 2, 7), ([1, 1], 4, 1), ([4, 3], 1, 8)];
    let make = move || sizes.map(|(size, side, channels)| Problem::new(size, side, channels)).into();
    Area { cases: vec![Case::sweep("sizes", 16, [Fault::Zero, Fault::NoBias], make)], ..area() }
}

pub fn area() -> Area {
    use Fault::*;
    let mut cases = Vec::new();
    let mut add = |name: &str, size: usize, catches: Catches<Fault>, make: fn() -> Problem| {
        cases.push(Case::new(name, size, catches, make));
    };
    let all = || Catches::from([Zero, NoBias, TurnedTaps, InOrder, NeighbourBias, Half]);
    add("4 x 4", 48, all(), || Problem::new([3, 4], 4, 48));
    add("2 x 2", 7, all(), || Problem::new([2, 5], 2, 7));
    add("one pixel", 4, [Zero, NoBias, TurnedTaps, NeighbourBias].into(), || Problem::new([1, 1], 4, 4));
    Area { kernel: "heads/pixel_shuffle", size: "channels", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
