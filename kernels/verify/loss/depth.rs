use crate::prelude::*;
use zipsplat::{
    refine::DepthKind,
    stages::{FrameShape, depth_loss::DepthFrames},
};
use zipsplat_reference::loss::depth::{CHANNELS, depth_loss, line};

const REASON: &str = "running error analysis of the line and of differences to it; sums over pixels in any order, relative to \
    their terms; the gradient's sign is open where the difference is within its error; colors are copied";

/// Additions of a run, a subgroup and a picture.
const ADDITIONS: usize = 2 * 8 + 128 + 8;
const WEIGHT: f32 = 0.75;

struct Problem {
    pixels: usize,
    kind: DepthKind,
    /// `[photos, pixels, 5]`.
    frames: Vec<f32>,
    /// `[photos, pixels]`.
    targets: Vec<f32>,
    /// `[photos, pixels, 3]`.
    d_colors: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    Ascent,
    /// Gradient by inverse depth.
    NoChainRule,
    OtherKind,
    NeighborLine,
    UnknownPixels,
    TransparentPixels,
    NeighborPixel,
    HalfResult,
}

impl Problem {
    /// Inverse depth is `slope` times the target plus noise.
    fn new(photos: usize, pixels: usize, kind: DepthKind, slope: f32) -> Self {
        let mut noise = Noise::new((photos + pixels) as u64);
        let count = photos * pixels;
        let (colors, known) = (noise.values(3 * count), noise.values(2 * count));
        let (spread, off) = (noise.values(count), noise.values(count));
        let (mut frames, mut targets) = (Vec::new(), Vec::new());
        for i in 0..count {
            let target = 2.0 + spread[i];
            let scale = slope * (1 + i / pixels) as f32;
            let inverse = if slope > 0.0 { 0.4 + scale * target } else { 4.0 + scale * target } + 0.3 * off[i];
            frames.extend([
                colors[3 * i],
                colors[3 * i + 1],
                colors[3 * i + 2],
                0.7 + 0.3 * known[2 * i],
                1.0 / inverse,
            ]);
            targets.push(if known[2 * i + 1] > 0.6 { 0.0 } else { target });
        }
        Self { pixels, kind, frames, targets, d_colors: noise.values(3 * count) }
    }

    fn photos(&self) -> usize {
        self.targets.len() / self.pixels
    }

    fn photo(&self, i: usize) -> (Vec<f64>, Vec<f64>) {
        let pixels = i * self.pixels..(i + 1) * self.pixels;
        let frames = &self.frames[CHANNELS * pixels.start..CHANNELS * pixels.end];
        (widen(frames), widen(&self.targets[pixels]))
    }

    fn line(&self, i: usize, kind: DepthKind) -> Option<[f64; 2]> {
        let (frames, targets) = self.photo(i);
        if kind == DepthKind::Relative { line(&frames, &targets) } else { Some([1.0, 0.0]) }
    }

    /// Colors, losses, gradients by the frames.
    fn of(&self, change: impl Fn(&mut [f64], &mut [f64]), line: impl Fn(usize) -> Option<[f64; 2]>) -> Vec<f64> {
        let (mut losses, mut d_frames) = (Vec::new(), Vec::new());
        for i in 0..self.photos() {
            let (mut frames, mut targets) = self.photo(i);
            change(&mut frames, &mut targets);
            let (loss, gradient) = depth_loss(&frames, &targets, line(i));
            losses.push(loss);
            for (k, gradient) in gradient.into_iter().enumerate() {
                let colors = &self.d_colors[3 * (i * self.pixels + k)..][..3];
                d_frames.extend(colors.iter().map(|color| f64::from(*color)));
                d_frames.extend([0.0, f64::from(WEIGHT) * gradient]);
            }
        }
        let colors = self.frames.chunks(CHANNELS).flat_map(|pixel| &pixel[..3]).map(|color| f64::from(*color));
        colors.chain(losses).chain(d_frames).collect()
    }

    fn errors(&self) -> Vec<f64> {
        let (mut losses, mut d_frames) = (Vec::new(), Vec::new());
        for i in 0..self.photos() {
            let (frames, targets) = self.photo(i);
            let line = self.line(i, self.kind);
            let (_, gradient) = depth_loss(&frames, &targets, line);
            let (one, exact) = (Bounded::exact(1.0), |value: f64| Bounded::exact(value));
            let pairs: Vec<_> = frames.chunks(CHANNELS).zip(&targets).zip(&gradient).collect();
            let known = |pixel: &[f64], target: f64| target > 0.0 && pixel[3] >= 0.5;
            let terms: Vec<[Bounded; 2]> = pairs
                .iter()
                .filter(|((pixel, target), _)| known(pixel, **target))
                .map(|((pixel, target), _)| [exact(**target), one / exact(pixel[4])])
                .collect();
            let sum = |of: &dyn Fn(&[Bounded; 2]) -> Bounded| {
                let all = terms.iter().map(of);
                let (value, error) = all.fold((0.0, 0.0), |(v, e), term| (v + term.value, e + term.error));
                Bounded { value, error: error + gamma(ADDITIONS) * (value.abs() + error) }
            };
            let n = exact(terms.len() as f64);
            let [t, y] = [sum(&|pair| pair[0]), sum(&|pair| pair[1])];
            let [slope, offset] = match (self.kind, line) {
                (DepthKind::Relative, Some(_)) => {
                    let [tt, ty] = [sum(&|pair| pair[0] * pair[0]), sum(&|pair| pair[0] * pair[1])];
                    let slope = (ty - t / n * y) / (tt - t / n * t);
                    [slope, (y - slope * t) / n]
                }
                (_, line) => line.unwrap_or_default().map(exact),
            };
            let mut loss = Bounded::exact(0.0);
            for ((pixel, target), gradient) in pairs {
                let mut error = 0.0;
                if line.is_some() && known(pixel, *target) {
                    let y = one / exact(pixel[4]);
                    let off = y - (slope * exact(*target) + offset);
                    let share = one / n;
                    let term = share * Bounded { value: off.value.abs(), error: off.error };
                    loss = Bounded { value: loss.value + term.value, error: loss.error + term.error };
                    let steep = exact(WEIGHT.into()) * share * y * y;
                    error = steep.error + if off.value.abs() <= off.error { 2.0 * steep.value } else { 0.0 };
                    debug_assert!(gradient.abs() <= steep.value * 2.0);
                }
                d_frames.extend([0.0, 0.0, 0.0, 0.0, error]);
            }
            losses.push(loss.error + gamma(ADDITIONS) * (loss.value + loss.error));
        }
        let colors = vec![0.0; 3 * self.targets.len()];
        [colors, losses, d_frames].concat()
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let inputs = [&self.frames, &self.targets].map(|values| trial.input(values));
        let (d_colors, weight) = (trial.input(&self.d_colors), trial.input(&[WEIGHT]));
        let shape = FrameShape { cameras: self.photos(), width: self.pixels as u32, height: 1 };
        let split = DepthFrames::record(&mut trial.rec, inputs, shape);
        let [value, d_frames] = split.record_backward(&mut trial.rec, d_colors, weight, self.kind);
        Ok(trial.results([split.colors, value, d_frames])?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        [self.of(|_, _| {}, |i| self.line(i, self.kind)), self.errors()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let first = truth.len() - CHANNELS * self.targets.len();
        let by_depth = |of: &dyn Fn(usize) -> f64| {
            let one = |(i, value): (usize, &f64)| match i.checked_sub(first) {
                Some(at) if at % CHANNELS == 4 => value * of(at),
                _ => *value,
            };
            truth.iter().enumerate().map(one).collect()
        };
        let line = |i: usize| self.line(i, self.kind);
        match fault {
            Fault::Ascent => by_depth(&|_| -1.0),
            Fault::NoChainRule => by_depth(&|at| f64::from(self.frames[at]).powi(2)),
            Fault::OtherKind => {
                let other = if self.kind == DepthKind::Metric { DepthKind::Relative } else { DepthKind::Metric };
                self.of(|_, _| {}, |i| self.line(i, other))
            }
            Fault::NeighborLine => self.of(|_, _| {}, |i| line((i + 1) % self.photos())),
            Fault::UnknownPixels => self.of(|_, targets| targets.iter_mut().for_each(|t| *t = t.max(1e-9)), line),
            Fault::TransparentPixels => {
                self.of(|frames, _| frames.chunks_mut(CHANNELS).for_each(|pixel| pixel[3] = 1.0), line)
            }
            Fault::NeighborPixel => shifted(truth, CHANNELS),
            Fault::HalfResult => halves(truth),
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("loss/depth", "pixels", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, photos, pixels, kind, slope, catches: Catches<Fault>| {
        area.add(name, pixels, catches, move || Problem::new(photos, pixels, kind, slope));
    };
    let each = [Ascent, NoChainRule, OtherKind, UnknownPixels, TransparentPixels, NeighborPixel, HalfResult];
    add("relative depth", 3, 4097, DepthKind::Relative, 0.5, Catches::from(each).and(&[NeighborLine]));
    add("depth in the scene's unit", 2, 1000, DepthKind::Metric, 1.0, each.into());
    add("a falling line", 1, 300, DepthKind::Relative, -1.0, [OtherKind, NeighborPixel, HalfResult].into());
    area
}
