use crate::prelude::*;
use zipsplat::kernels::heads::PixelShuffle;
use zipsplat_reference::heads::pixel_shuffle::pixel_shuffle;

const REASON: &str = "every result is one value and one bias, whose sum rounds once";

/// `[height, width, side, side, channels]`.
struct Problem {
    width: usize,
    side: usize,
    values: Vec<f32>,
    bias: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    NoBias,
    TurnedTaps,
    InOrder,
    NeighborBias,
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

impl Values for Problem {
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

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let truth = self.spread(&widen(&self.values), &self.bias);
        let bounds = truth.iter().map(|x| U * x.abs() + TINY).collect();
        [truth, bounds]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (values, channels, taps) = (widen(&self.values), self.bias.len(), self.side * self.side);
        match fault {
            Fault::NoBias => self.spread(&values, &vec![0.0; channels]),
            Fault::TurnedTaps => {
                let turned = |i: usize| {
                    let (tap, whole) = (i / channels % taps, i - i % (channels * taps));
                    values[whole + (tap % self.side * self.side + tap / self.side) * channels + i % channels]
                };
                self.spread(&(0..values.len()).map(turned).collect::<Vec<_>>(), &self.bias)
            }
            Fault::InOrder => values.iter().enumerate().map(|(i, x)| x + f64::from(self.bias[i % channels])).collect(),
            Fault::NeighborBias => {
                let bias: Vec<f32> = (0..channels).map(|c| self.bias[(c + 1) % channels]).collect();
                self.spread(&values, &bias)
            }
            Fault::Half => halves(truth),
        }
    }
}

pub fn shapes() -> Area {
    let sizes = [([3, 4], 4, 16), ([2, 5], 2, 7), ([1, 1], 4, 1), ([4, 3], 1, 8)];
    let make = move || sizes.map(|(size, side, channels)| Problem::new(size, side, channels)).into();
    let mut area = Area { cases: Vec::new(), ..area() };
    area.sweep("sizes", 16, [Fault::NoBias], make);
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("heads/pixel_shuffle", "channels", Mode::ONLY_EXACT, REASON);
    let all = || Catches::from([NoBias, TurnedTaps, InOrder, NeighborBias, Half]);
    area.add("4 x 4", 48, all(), || Problem::new([3, 4], 4, 48));
    area.add("2 x 2", 7, all(), || Problem::new([2, 5], 2, 7));
    area.add("one pixel", 4, [NoBias, TurnedTaps, NeighborBias], || Problem::new([1, 1], 4, 4));
    area
}
