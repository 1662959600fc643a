use crate::prelude::*;
use zipsplat::{
    gpu::Tensor,
    kernels::{limits::TILE, render::RasterizeBackward},
};
use zipsplat_reference::render::{
    backward::{Ellipse, through_pixel},
    project::MIN_ALPHA,
    rasterize::{MAX_ALPHA, MIN_TRANSMITTANCE},
};

const REASON: &str = "running error analysis of blending and of what lies behind each splat, pixel by pixel, then gamma_256 of a tile's \
    sums; pixels where rounding may move an alpha or a transmittance over a threshold have no gradient";

pub(crate) const WIDTH: u32 = 40;
pub(crate) const HEIGHT: u32 = 23;
const BACKGROUND: [f64; 3] = [0.25, 0.5, 0.125];
/// Pixels outside the picture where splats start to use their ridge.
const FAR_OFF: f32 = 256.0;
/// Moments, red, green, blue, depth.
const VALUES: usize = 10;

#[derive(Clone, Copy)]
pub(crate) struct Splat {
    pub place: [f32; 2],
    pub conic: [f32; 3],
    pub opacity: f32,
    color: [f32; 3],
    depth: f32,
}

/// Splats from near to far with a slot per tile, and pixel gradients of RGB, alpha and depth.
struct Problem {
    splats: Vec<Splat>,
    frames: Vec<f32>,
    d_frames: Vec<f32>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Fault {
    Unwritten,
    NothingBehind,
    NoBackground,
    Unclamped,
    NeverStops,
    FaintDrawn,
    NoAlpha,
    NoDepth,
    /// Moments of x offsets from the center instead of the ridge.
    Unsheared,
    NeighborSplat,
    NeighborTile,
    LastPixelRow,
}

impl Splat {
    fn ridge(&self) -> f32 {
        let y = self.place[1];
        if y < -FAR_OFF || y > HEIGHT as f32 + FAR_OFF { y.clamp(0.0, HEIGHT as f32) } else { y }
    }

    pub fn ellipse(&self) -> Ellipse {
        Ellipse {
            place: self.place.map(f64::from),
            ridge: self.ridge().into(),
            conic: self.conic.map(f64::from),
            opacity: self.opacity.into(),
            color: self.color.map(f64::from),
            depth: self.depth.into(),
        }
    }
}

pub(crate) fn tiles() -> [usize; 2] {
    [WIDTH, HEIGHT].map(|side| side.div_ceil(TILE) as usize)
}

pub(crate) struct Lists {
    pub pair_indices: Tensor,
    pub tile_offsets: Tensor,
    pub tile_sets: Tensor,
    pub slots: Tensor,
}

impl Lists {
    pub fn record(trial: &mut Trial<'_>, count: u32) -> Self {
        let [columns, rows] = tiles().map(|side| side as u32);
        let tiles = columns * rows;
        let all: Vec<u32> = (0..tiles).flat_map(|_| 0..count).collect();
        let multiples = |last: u32, of: u32| (0..=last).map(|i| i * of).collect::<Vec<u32>>();
        // All tiles, without a mask.
        let sets: Vec<[u32; 3]> = vec![[0, columns | rows << 16, 0]; count as usize];
        Self {
            pair_indices: trial.input(&all),
            tile_offsets: trial.input(&multiples(tiles, count)),
            tile_sets: trial.input(&sets),
            slots: trial.input(&multiples(count, tiles)),
        }
    }
}

pub(crate) fn pixels() -> impl Iterator<Item = (usize, [f64; 2])> {
    (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| [x, y])).map(|[x, y]| {
        let tile = (y / TILE) as usize * tiles()[0] + (x / TILE) as usize;
        (tile, [f64::from(x) + 0.5, f64::from(y) + 0.5])
    })
}

pub(crate) type Share = [Bounded; VALUES];

/// Mirrors render/rasterize_backward.comp on one pixel; `None` if rounding may flip a threshold.
pub(crate) fn pixel(
    splats: &[Splat],
    [x, y]: [f64; 2],
    frame: [f64; 5],
    d: [Bounded; 5],
    fault: Option<Fault>,
) -> Option<Vec<Share>> {
    let (one, zero) = (Bounded::exact(1.0), Bounded::exact(0.0));
    // With a fault only values count.
    let near = |b: Bounded, to: f64| fault.is_none() && (b.value - to).abs() <= b.error;
    let is = |other: Fault| fault == Some(other);
    let d =
        [0, 1, 2, 3, 4].map(|i| if is(Fault::NoAlpha) && i == 3 || is(Fault::NoDepth) && i == 4 { zero } else { d[i] });
    let background = if is(Fault::NoBackground) { frame[3] - 1.0 } else { 0.0 };
    let seen = |i: usize| Bounded::rounded(frame[i] + if i < 3 { background * BACKGROUND[i] } else { 0.0 });
    let mut behind = Bounded::dot([seen(0), seen(1), seen(2)], [d[0], d[1], d[2]]) + seen(3) * d[3] + seen(4) * d[4];
    let (mut left, mut done) = (one, false);
    let mut shares = vec![[zero; VALUES]; splats.len()];
    let [faint, stop] = [(Fault::FaintDrawn, MIN_ALPHA), (Fault::NeverStops, MIN_TRANSMITTANCE)]
        .map(|(without, threshold)| if is(without) { 0.0 } else { threshold });
    for (splat, share) in splats.iter().zip(&mut shares) {
        let [px, py] = splat.place.map(Bounded::exact);
        let [a, k, p] = splat.conic.map(Bounded::exact);
        // From the tile's first pixel to a run's, then to the invocation's.
        let start = |at: f64| (at / f64::from(TILE)).floor() * f64::from(TILE) + 0.5;
        let from = |at: f64, place: Bounded| Bounded::exact(start(at)) - place + zero + Bounded::exact(at - start(at));
        let (dx, dy) = (from(x, px), from(y, py));
        let shear = k * from(y, Bounded::exact(splat.ridge()));
        let e = dx - shear;
        let log2 = Bounded::rounded(-0.5 * std::f64::consts::LOG2_E);
        let exponent = (a * log2) * e * e + (p * log2) * dy * dy;
        let full = Bounded::exact(splat.opacity) * exponent.exp2();
        let alpha = full.min(Bounded::rounded(MAX_ALPHA));
        if near(alpha, faint) || near(full, MAX_ALPHA) {
            return None;
        }
        let after = left * (one - alpha);
        let visible = alpha.value >= faint && !done;
        if visible && near(after, stop) {
            return None;
        }
        if visible && after.value <= stop {
            done = true;
        }
        if !visible || done {
            continue;
        }
        let weight = alpha * left;
        let rgb = splat.color.map(Bounded::exact);
        let value = weight * (Bounded::dot(rgb, [d[0], d[1], d[2]]) + Bounded::exact(splat.depth) * d[4] + d[3]);
        behind = behind - value;
        let held = full.value > MAX_ALPHA && !is(Fault::Unclamped);
        let hidden = if is(Fault::NothingBehind) { zero } else { behind * alpha / (one - alpha) };
        let g = if held { zero } else { value - hidden };
        let e = if is(Fault::Unsheared) { dx } else { e };
        let (ge, gy) = (g * e, g * dy);
        let [red, green, blue, depth] = [0, 1, 2, 4].map(|i| weight * d[i]);
        *share = [g, ge, gy, ge * e, gy * e, gy * dy, red, green, blue, depth];
        left = after;
    }
    Some(shares)
}

impl Problem {
    /// 0 where rounding may flip a threshold.
    fn new(splats: Vec<Splat>) -> Self {
        let mut noise = Noise::new(splats.len() as u64);
        let (mut frames, mut d_frames) = (Vec::new(), Vec::new());
        for (_, at) in pixels() {
            let frame = frame(&splats, at);
            let d = noise.values(5);
            let stable = pixel(&splats, at, frame, [Bounded::exact(0.0); 5], None).is_some();
            frames.extend(frame.map(|value| value as f32));
            d_frames.extend(d.into_iter().map(|d| if stable { d } else { 0.0 }));
        }
        Self { splats, frames, d_frames }
    }

    /// `[splats, tiles, VALUES]`, summed over tiles.
    fn slots(&self, fault: Option<Fault>) -> Vec<Bounded> {
        let count = tiles()[0] * tiles()[1];
        let mut slots = vec![Bounded::exact(0.0); self.splats.len() * count * VALUES];
        let mut magnitudes = vec![0.0; slots.len()];
        for (i, (tile, at)) in pixels().enumerate() {
            let numbers = |from: &[f32]| -> [f64; 5] { std::array::from_fn(|c| from[5 * i + c].into()) };
            let (frame, d) = (numbers(&self.frames), numbers(&self.d_frames).map(Bounded::exact));
            let last = fault == Some(Fault::LastPixelRow) && at[1] + 1.0 > f64::from(HEIGHT);
            if d.iter().all(|d| d.value == 0.0) || last {
                continue;
            }
            let tile = if fault == Some(Fault::NeighborTile) { (tile + 1) % count } else { tile };
            for (n, share) in pixel(&self.splats, at, frame, d, fault).into_iter().flatten().enumerate() {
                for (value, share) in share.into_iter().enumerate() {
                    let slot = (n * count + tile) * VALUES + value;
                    slots[slot].value += share.value;
                    slots[slot].error += share.error;
                    magnitudes[slot] += share.value.abs() + share.error;
                }
            }
        }
        let sums = gamma((TILE * TILE) as usize);
        slots.iter_mut().zip(magnitudes).for_each(|(slot, magnitude)| slot.error += sums * magnitude);
        slots
    }
}

/// Red, green, blue without the background, alpha, depth.
fn frame(splats: &[Splat], at: [f64; 2]) -> [f64; 5] {
    let ellipses: Vec<Ellipse> = splats.iter().map(Splat::ellipse).collect();
    // A splat's weight is its gradient with unit red.
    let weights = through_pixel(&ellipses, at, [1.0, 0.0, 0.0, 0.0, 0.0], [0.0; 3]);
    let mut frame = [0.0; 5];
    for (splat, weight) in ellipses.iter().zip(weights.iter().map(|gradient| gradient[6])) {
        (0..3).for_each(|c| frame[c] += weight * splat.color[c]);
        frame[3] += weight;
        frame[4] += weight * splat.depth;
    }
    (0..3).for_each(|c| frame[c] += (1.0 - frame[3]) * BACKGROUND[c]);
    frame
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let ([columns, rows], count) = (tiles(), self.splats.len() as u32);
        let lists = Lists::record(&mut trial, count);
        let of = |values: &dyn Fn(&Splat) -> [f32; 3]| self.splats.iter().map(values).collect::<Vec<_>>();
        let depths: Vec<f32> = self.splats.iter().map(|splat| splat.depth).collect();
        let capacity = count as usize * columns * rows;
        let (moments, d_values) = (trial.output::<[f32; 6]>(capacity), trial.output::<[f32; 4]>(capacity));
        let kernel = RasterizeBackward {
            pair_indices: lists.pair_indices,
            tile_offsets: lists.tile_offsets,
            tile_sets: lists.tile_sets,
            slots: lists.slots,
            xy_opacities: trial.input(&of(&|splat| [splat.place[0], splat.place[1], splat.opacity])),
            conics: trial.input(&of(&|splat| splat.conic)),
            colors: trial.input(&of(&|splat| splat.color)),
            depths: trial.input(&depths),
            frames: trial.input(&self.frames),
            d_frames: trial.input(&self.d_frames),
            moments,
            d_values,
            size: [WIDTH, HEIGHT],
            grid: [columns as u32, rows as u32],
            first_tile_row: 0,
            row_count: HEIGHT,
            capacity: capacity as u32,
            runs: TILE * TILE / device.limits().subgroup_size,
            color: true,
            alpha: true,
            depth: true,
            expected_depth: false,
            batched: !device.limits().cpu,
        };
        trial.rec.dispatch_groups(kernel, [columns as u32, rows as u32, 1]);
        Ok(joined(&trial.results([moments, d_values])?, [6, 4]))
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let count = tiles()[0] * tiles()[1];
        let ellipses: Vec<Ellipse> = self.splats.iter().map(Splat::ellipse).collect();
        let mut sums = vec![0.0; self.splats.len() * count * VALUES];
        for (i, (tile, at)) in pixels().enumerate() {
            let d = std::array::from_fn(|c| self.d_frames[5 * i + c].into());
            for (n, gradient) in through_pixel(&ellipses, at, d, BACKGROUND).into_iter().enumerate() {
                (0..VALUES).for_each(|value| sums[(n * count + tile) * VALUES + value] += gradient[value]);
            }
        }
        [sums, self.slots(None).iter().map(|slot| slot.error).collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        match fault {
            Fault::Unwritten => vec![f64::NAN; truth.len()],
            Fault::NeighborSplat => shifted(truth, tiles()[0] * tiles()[1] * VALUES),
            _ => self.slots(Some(fault)).iter().map(|slot| slot.value).collect(),
        }
    }
}

/// 1 to 10 pixels wide.
pub(crate) fn splats(count: usize, change: impl Fn(usize, &mut Splat)) -> Vec<Splat> {
    let mut noise = Noise::new(count as u64 + 7);
    let mut one = |i: usize| {
        let mut uniform = |low, high| noise.uniform(low, high);
        let mut splat = Splat {
            place: [uniform(0.0, WIDTH as f32), uniform(0.0, HEIGHT as f32)],
            conic: [uniform(0.01, 1.0), uniform(-1.0, 1.0), uniform(0.01, 1.0)],
            opacity: uniform(0.1, 0.95),
            color: [(); 3].map(|()| uniform(0.0, 1.0)),
            depth: 1.0 + i as f32 / 8.0,
        };
        change(i, &mut splat);
        splat
    };
    (0..count).map(&mut one).collect()
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("render/rasterize_backward", "splats", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, count: usize, change: fn(usize, &mut Splat)| {
        area.add(name, count, catches, move || Problem::new(splats(count, change)));
    };
    let seen = || Catches::from([Unwritten, NoAlpha, NoDepth, NeighborTile, LastPixelRow]);
    let many = || seen().and(&[NothingBehind, NoBackground, Unsheared, NeighborSplat, FaintDrawn]);
    add("one", seen().and(&[NoBackground]), 1, |_, splat| splat.opacity = 0.8);
    add("random", many(), 10, |_, _| ());
    add("random", many(), 100, |_, _| ());
    // Thin, in any direction, from border to border.
    add("needles", many(), 40, |_, splat| splat.conic = [3.0, splat.conic[1], 1e-6]);
    add("needles whose center is 1e5 pixels off", [Unwritten, NothingBehind].into(), 20, |i, splat| {
        splat.place[1] = if i % 2 == 0 { -1e5 } else { 1e5 };
        splat.conic = [3.0, 0.1 * splat.conic[1], 1e-11];
    });
    add("opaque stacks", [Unwritten, NothingBehind, Unclamped, NeverStops].into(), 50, |_, splat| {
        (splat.opacity, splat.conic) = (1.0, [1e-5, 0.0, 1e-5]);
    });
    add("thousands on one pixel", [Unwritten, NothingBehind, NeverStops].into(), 4000, |i, splat| {
        splat.place = [20.3, 11.6];
        splat.conic = [0.3, 0.2, 0.3];
        splat.opacity = 0.006 + 0.001 * (i % 7) as f32;
    });
    add("nothing visible", [Unwritten, FaintDrawn].into(), 30, |_, splat| splat.opacity = 0.003);
    area
}
