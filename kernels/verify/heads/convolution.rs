use crate::prelude::*;
use zipsplat::{
    ops::{FeatureMap, Lanes, Linear, LinearKernel, Weights, pack_matrix},
    stages::heads::{Convolution, ConvolutionOptions},
};
use zipsplat_reference::heads::convolution::convolution;

const REASON: &str = "a sum of n products and a bias is off by gamma_(n+1) (|x| |w| + |b|) in any order (Higham 2002, section \
    4.2), n being taps times channels; what is added to it costs one rounding more. Pixels outside are exactly 0";

/// Map `[height, width, channels]` and its zero-padded convolution.
struct Problem {
    size: [usize; 2],
    channels: usize,
    columns: usize,
    shape: [usize; 2],
    rectified: bool,
    x: Vec<f32>,
    /// `[columns, channels, side, side]`.
    weight: Vec<f32>,
    bias: Vec<f32>,
    residual: Option<Vec<f32>>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    NoBias,
    NoResidual,
    Unrectified,
    LastTap,
    LastChannel,
    TurnedTaps,
    RepeatedEdge,
    NeighborPixel,
    Half,
}

impl Problem {
    fn new(size: [usize; 2], [channels, columns]: [usize; 2], shape: [usize; 2]) -> Self {
        let seed = size[0] * 31 + channels * 7 + columns;
        let mut noise = Noise::new(seed as u64);
        let (x, weight) =
            (noise.values(size[0] * size[1] * channels), noise.values(columns * channels * shape[0].pow(2)));
        let bias = noise.values(columns);
        Self { size, channels, columns, shape, rectified: false, x, weight, bias, residual: None }
    }

    fn residual(self) -> Self {
        let residual = Noise::new(17).values(self.out_size().iter().product::<usize>() * self.columns);
        Self { rectified: true, residual: Some(residual), ..self }
    }

    fn out_size(&self) -> [usize; 2] {
        let [side, step] = self.shape;
        self.size.map(|length| (length + side / 2 * 2 - side) / step + 1)
    }

    fn seen(&self, rectified: bool) -> Vec<f64> {
        widen(&self.x).into_iter().map(|x| if rectified { x.max(0.0) } else { x }).collect()
    }

    fn convolved(&self, x: &[f64], weight: &[f32], bias: &[f32]) -> Vec<f64> {
        convolution(x, [self.size[1], self.channels], self.shape, weight, bias)
    }

    fn added(&self, values: Vec<f64>) -> Vec<f64> {
        match &self.residual {
            Some(residual) => values.iter().zip(residual).map(|(x, &r)| x + f64::from(r)).collect(),
            None => values,
        }
    }

    /// `value` maps a weight, channel and tap.
    fn weighed(&self, value: impl Fn(&[f32], usize, usize) -> f32) -> Vec<f32> {
        let taps = self.shape[0].pow(2);
        let rows = self.weight.chunks(taps * self.channels);
        rows.flat_map(|row| (0..row.len()).map(|i| value(row, i / taps, i % taps)).collect::<Vec<_>>()).collect()
    }

    fn with_repeated_edge(&self) -> Vec<f64> {
        let ([height, width], [side, step], padding) = (self.size, self.shape, self.shape[0] / 2);
        let x = self.seen(self.rectified);
        let inside = |at: usize, length: usize| at.saturating_sub(padding).min(length - 1);
        let [rows, columns] = self.out_size();
        let patch = self.channels * side * side;
        let one = |i: usize| {
            let (y, x_at, c) = (i / self.columns / columns, i / self.columns % columns, i % self.columns);
            let term = |(i, &w): (usize, &f32)| {
                let (channel, tap) = (i / (side * side), i % (side * side));
                let (v, u) = (inside(y * step + tap / side, height), inside(x_at * step + tap % side, width));
                f64::from(w) * x[(v * width + u) * self.channels + channel]
            };
            f64::from(self.bias[c]) + self.weight[c * patch..][..patch].iter().enumerate().map(term).sum::<f64>()
        };
        (0..rows * columns * self.columns).map(one).collect()
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let ([out_height, out_width], taps) = (self.out_size(), self.shape[0].pow(2));
        let inner = taps * self.channels;
        // Channels are innermost on the device.
        let row =
            |row: &[f32]| (0..inner).map(|i| row[i % self.channels * taps + i / self.channels]).collect::<Vec<_>>();
        let turned: Vec<f32> = self.weight.chunks(inner).flat_map(row).collect();
        let panels = LinearKernel::Panels(Lanes::of(Element::F32), Weights::Factors);
        let packed = pack_matrix(panels, &turned, inner, self.columns);
        let pixels = out_height * out_width;
        let mut trial = Trial::new(device);
        let map = |tensor, [height, width]: [usize; 2], channels| {
            FeatureMap::new(Rows::new(tensor, height * width, channels), [height, width])
        };
        let out = trial.output::<f32>(pixels * self.columns);
        let layer = Linear {
            weight: trial.input(&packed),
            bias: trial.input(&self.bias),
            inner,
            columns: self.columns,
            kernel: panels,
        };
        let source = map(trial.input(&self.x), self.size, self.channels);
        let result = map(out, self.out_size(), self.columns);
        let residual = self.residual.as_ref().map(|residual| map(trial.input(residual), self.out_size(), self.columns));
        let how = ConvolutionOptions { rectified: self.rectified, residual, ..ConvolutionOptions::default() };
        Convolution::of(layer, self.shape).record_into(&mut trial.rec, source, result, how);
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let x = self.seen(self.rectified);
        let sizes = |values: &[f32]| values.iter().map(|value| value.abs()).collect::<Vec<_>>();
        let magnitude: Vec<f64> = x.iter().map(|x| x.abs()).collect();
        let magnitudes = self.convolved(&magnitude, &sizes(&self.weight), &sizes(&self.bias));
        let truth = self.added(self.convolved(&x, &self.weight, &self.bias));
        let terms = self.channels * self.shape[0].pow(2);
        let bound = |(truth, magnitude): (&f64, &f64)| {
            let sum = gamma(terms + 1) * magnitude + (terms + 1) as f64 * TINY;
            if self.residual.is_some() { sum + 2.0 * U * (truth.abs() + sum) } else { sum }
        };
        let bounds = truth.iter().zip(&magnitudes).map(bound).collect();
        [truth, bounds]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (x, side) = (self.seen(self.rectified), self.shape[0]);
        let weighed = |value: &dyn Fn(&[f32], usize, usize) -> f32| {
            self.added(self.convolved(&x, &self.weighed(value), &self.bias))
        };
        let at = |row: &[f32], channel: usize, tap: usize| row[channel * side * side + tap];
        match fault {
            Fault::NoBias => self.added(self.convolved(&x, &self.weight, &vec![0.0; self.columns])),
            Fault::NoResidual => self.convolved(&x, &self.weight, &self.bias),
            Fault::Unrectified => self.added(self.convolved(&self.seen(false), &self.weight, &self.bias)),
            Fault::LastTap => weighed(&|row, c, tap| if tap + 1 == side * side { 0.0 } else { at(row, c, tap) }),
            Fault::LastChannel => weighed(&|row, c, tap| if c + 1 == self.channels { 0.0 } else { at(row, c, tap) }),
            Fault::TurnedTaps => weighed(&|row, c, tap| at(row, c, tap % side * side + tap / side)),
            Fault::RepeatedEdge => self.added(self.with_repeated_edge()),
            Fault::NeighborPixel => shifted(truth, self.columns),
            Fault::Half => halves(truth),
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("heads/convolution", "channels", Mode::ONLY_EXACT, REASON);
    let all = || Catches::from([NoBias, LastTap, LastChannel, TurnedTaps, RepeatedEdge, NeighborPixel]);
    area.add("3 x 3", 4, all(), || Problem::new([5, 7], [4, 5], [3, 1]));
    area.add("3 x 3", 64, all(), || Problem::new([9, 6], [64, 70], [3, 1]));
    area.add("3 x 3", 512, all(), || Problem::new([4, 5], [512, 33], [3, 1]));
    area.add("every second pixel", 16, all(), || Problem::new([7, 8], [16, 12], [3, 2]));
    let residual = Catches::from([NoResidual, Unrectified, LastTap, RepeatedEdge, Half]);
    area.add("residual", 32, residual, || Problem::new([6, 11], [32, 32], [3, 1]).residual());
    let single = Catches::from([NoBias, LastChannel, NeighborPixel, Half]);
    area.add("one tap", 32, single, || Problem::new([3, 13], [32, 2], [1, 1]));
    area.add("one pixel", 8, [NoBias, RepeatedEdge], || Problem::new([1, 1], [8, 4], [3, 1]));
    area
}
