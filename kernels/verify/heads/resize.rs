use crate::prelude::*;
use zipsplat::kernels::heads::Resize;
use zipsplat_reference::heads::resize::resize;

const REASON: &str = "the share of a neighbor is a quotient of whole numbers, off by 2.5 units in the last place at most (Vulkan \
    specification); three weighted means and the sum behind them round 9 times. No value is larger than the four neighbors together";

const ROUNDINGS: usize = 9;

/// Map `[height, width, channels]`, with optional positions of columns and rows.
struct Problem {
    size: [usize; 2],
    to: [usize; 2],
    channels: usize,
    x: Vec<f32>,
    positions: Option<Vec<f32>>,
    /// First output line, first bound source line.
    lines: [usize; 2],
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    MiddlesOnMiddles,
    Nearest,
    Turned,
    NoPositions,
    TurnedPositions,
    NeighborPixel,
    Half,
}

impl Problem {
    fn new(size: [usize; 2], to: [usize; 2], channels: usize) -> Self {
        let x = Noise::new((size[0] * 31 + channels) as u64).values(size[0] * size[1] * channels);
        Self { size, to, channels, x, positions: None, lines: [0; 2] }
    }

    fn placed(self) -> Self {
        let positions = Noise::new(23).values((self.to[0] + self.to[1]) * self.channels / 2);
        Self { positions: Some(positions), ..self }
    }

    /// Columns go to the first half of the channels, or rows if `turned`.
    fn added(&self, values: Vec<f64>, turned: bool) -> Vec<f64> {
        let Some(positions) = &self.positions else { return values };
        let (half, width) = (self.channels / 2, self.to[1]);
        let position = |i: usize| {
            let (pixel, channel) = (i / self.channels, i % self.channels);
            let line = width + pixel / width;
            let at = if (channel < half) != turned { pixel % width } else { line };
            f64::from(positions[at * half + channel % half])
        };
        values.into_iter().enumerate().map(|(i, value)| value + position(i)).collect()
    }

    fn resized(&self) -> Vec<f64> {
        resize(&widen(&self.x), [self.size[1], self.channels], self.to)
    }

    /// At `[y, x]`, bilinearly or by nearest neighbor.
    fn sampled(&self, place: impl Fn(usize, usize) -> f64, nearest: bool) -> Vec<f64> {
        let [height, width] = self.size;
        let at = |y: usize, x: usize, c: usize| f64::from(self.x[(y * width + x) * self.channels + c]);
        let parts = |place: f64, length: usize| {
            let place = place.clamp(0.0, (length - 1) as f64);
            let share = if nearest { place.fract().round() } else { place.fract() };
            (place as usize, (place as usize + 1).min(length - 1), share)
        };
        let value = |i: usize| {
            let (pixel, c) = (i / self.channels, i % self.channels);
            let (upper, lower, low) = parts(place(pixel / self.to[1], 0), height);
            let (left, right, share) = parts(place(pixel % self.to[1], 1), width);
            let line = |y: usize| (1.0 - share) * at(y, left, c) + share * at(y, right, c);
            (1.0 - low) * line(upper) + low * line(lower)
        };
        (0..self.to[0] * self.to[1] * self.channels).map(value).collect()
    }

    fn place(&self, at: usize, axis: usize) -> f64 {
        (at * (self.size[axis] - 1)) as f64 / (self.to[axis].max(2) - 1) as f64
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let ([height, width], [out_height, out_width]) = (self.size, self.to);
        let [first, source_first] = self.lines;
        let pixels = (out_height - first) * out_width;
        let mut trial = Trial::new(device);
        let source = trial.input(&self.x[source_first * width * self.channels..]);
        let out = trial.output::<f32>(pixels * self.channels);
        let kernel = Resize {
            source,
            positions: self.positions.as_ref().map_or(source, |positions| trial.input(positions)),
            out,
            pixels: pixels as u32,
            first: first as u32,
            out_width: out_width as u32,
            out_height: out_height as u32,
            channels: self.channels as u32,
            width: width as u32,
            height: height as u32,
            source_first: source_first as u32,
            placed: self.positions.is_some(),
        };
        trial.rec.dispatch_groups(kernel, pixels);
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let largest = |values: &[f32]| values.iter().fold(0.0, |most, value| value.abs().max(most));
        let four = 4.0 * f64::from(largest(&self.x)) + f64::from(self.positions.as_deref().map_or(0.0, largest));
        let mut truth = self.added(self.resized(), false);
        truth.drain(..self.lines[0] * self.to[1] * self.channels);
        let bound = (2.0 * DIVISION + gamma(ROUNDINGS)) * four + ROUNDINGS as f64 * TINY;
        let bounds = vec![bound; truth.len()];
        [truth, bounds]
    }

    fn typical(&self, _: Mode) -> Tolerance {
        Tolerance::ELEMENTWISE
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let middle = |at: usize, axis: usize| (at as f64 + 0.5) * self.size[axis] as f64 / self.to[axis] as f64 - 0.5;
        let values = match fault {
            Fault::MiddlesOnMiddles => self.added(self.sampled(middle, false), false),
            Fault::Nearest => self.added(self.sampled(|at, axis| self.place(at, axis), true), false),
            Fault::Turned => {
                let turned = |at: usize, axis: usize| {
                    self.place(at, 1 - axis) * (self.size[axis] - 1) as f64 / (self.size[1 - axis] - 1).max(1) as f64
                };
                self.added(self.sampled(turned, false), false)
            }
            Fault::NoPositions => self.resized(),
            Fault::TurnedPositions => self.added(self.resized(), true),
            Fault::NeighborPixel => shifted(truth, self.channels),
            Fault::Half => halves(truth),
        };
        values[values.len() - truth.len()..].to_vec()
    }
}

pub fn shapes() -> Area {
    let sizes = [
        ([3, 4, 8], [6, 8]),
        ([24, 16, 4], [42, 28]),
        ([3, 2, 68], [5, 4]),
        ([1, 2, 4], [2, 3]),
        ([2, 1, 4], [3, 5]),
        ([5, 6, 4], [1, 1]),
        ([5, 6, 4], [5, 6]),
    ];
    let whole = move || {
        let of = |([height, width, channels], to): ([usize; 3], _)| Problem::new([height, width], to, channels);
        sizes.into_iter().flat_map(|size| [of(size), of(size).placed()]).collect()
    };
    // Line 5 of 9 lies at 5 * 4 / 8 = 2.5 of the source.
    let part = || Problem { lines: [5, 2], ..Problem::new([5, 3], [9, 7], 4).placed() };
    let mut area = Area { cases: Vec::new(), ..area() };
    area.sweep("sizes", 4, [], whole);
    area.add("part of a picture", 4, [Fault::MiddlesOnMiddles, Fault::Nearest], part);
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("heads/resize", "channels", Mode::ONLY_EXACT, REASON);
    let all = || Catches::from([MiddlesOnMiddles, Nearest, Turned, NeighborPixel, Half]);
    area.add("larger", 4, all(), || Problem::new([4, 6], [7, 13], 4));
    area.add("larger", 64, all().and(&[NoPositions, TurnedPositions]), || {
        Problem::new([16, 24], [28, 42], 64).placed()
    });
    area.add("smaller", 8, all(), || Problem::new([9, 7], [4, 5], 8));
    area.add("one line", 4, [Nearest, NeighborPixel], || Problem::new([1, 5], [3, 8], 4));
    area.add("one pixel", 4, [NoPositions], || Problem::new([1, 1], [5, 3], 4).placed());
    area
}
