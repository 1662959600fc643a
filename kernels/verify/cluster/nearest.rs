use super::kernel;
use crate::prelude::*;
use zipsplat::{kernels::limits::NEAREST_ROWS, ops::Nearest};
use zipsplat_reference::cluster::{
    nearest::{TIE, error_of_products, two_nearest},
    origin::origin,
};

const REASON: &str = "a squared distance is a sum of w squares without cancellation, off by gamma_(w+3) of itself at most; \
    what is chosen may so be farther than the nearest by 2 gamma_(w+3) / (1 - gamma_(w+3)), relatively, and by the 2^-16 within \
    which targets tie, and no more. On matrix units it is |t|^2 - 2 p t about an origin, of two f16 for each value, off by what \
    kernels/cluster/nearest_matrix.comp derives; what is chosen may be farther by that of both, and by a tie. Of two targets \
    that only rounding tells apart it must be the first";

/// Points and targets, `[_, width]`.
pub struct Problem {
    pub width: usize,
    pub points: Vec<f32>,
    pub targets: Vec<f32>,
}

pub struct Chosen {
    pub targets: Vec<u32>,
    /// Origin for matrix units.
    pub origin: Option<Vec<f32>>,
}

pub struct Truth {
    points: Vec<f64>,
    targets: Vec<f64>,
    nearest: Vec<[(u32, f64); 2]>,
}

#[derive(Clone, Copy, Debug)]
pub enum Fault {
    First,
    SecondNearest,
    LastOfEqual,
    LaterOfTwo,
    NextIndex,
    LastTarget,
    LastChannels,
    /// |t|^2 - 2 p t in f32, without an offset.
    Products,
    /// 11-bit sums of squares.
    HalfSum,
    Folded,
}

impl Truth {
    pub fn new(points: &[f32], targets: &[f32], width: usize) -> Self {
        let (points, targets) = (widen(points), widen(targets));
        let nearest = two_nearest(&points, &targets, width);
        Self { points, targets, nearest }
    }

    pub(super) fn first(&self) -> Vec<u32> {
        self.nearest.iter().map(|[first, _]| first.0).collect()
    }

    /// Returns the excess squared distance of the chosen targets.
    pub fn excess(&self, chosen: &Chosen, width: usize) -> Worst {
        let squared = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        let origin = chosen.origin.as_deref().map(widen);
        let slack = 2.0 * gamma(width + 3) / (1.0 - gamma(width + 3));
        let (mut worst, mut beyond) = (Worst::NONE, 0.0f64);
        let points = self.points.chunks(width).zip(&chosen.targets);
        for ((point, &index), &[(first, nearest), (second, next)]) in points.zip(&self.nearest) {
            let Some(target) = self.targets.chunks(width).nth(index as usize) else {
                return Worst::one(f64::NAN, 0.0, 0.0);
            };
            let best = &self.targets[first as usize * width..][..width];
            let [nearest, next] = [nearest, next].map(|distance| distance * distance);
            let farther = (squared(point, target) - nearest).max(0.0);
            // Squares below 2^-126 may be flushed.
            let least = nearest.max(1e-30);
            let bound = TIE * least
                + match &origin {
                    None => slack * least,
                    Some(origin) => {
                        let error = |row| error_of_products([point, row].map(|row| squared(row, origin).sqrt()), width);
                        let both = error(target) + error(best);
                        beyond = beyond.max((farther - TIE * nearest) / both);
                        both
                    }
                };
            let rows = || self.targets.chunks(width);
            let alone = || rows().filter(|row| squared(point, row) <= nearest + 2.0 * bound).count() == 2;
            let tied = index > first.min(second) && next * (1.0 + slack) <= nearest * (1.0 + TIE) && alone();
            let later = index > first && target == best || tied;
            worst = worst.or(Worst::one(if later { f64::INFINITY } else { farther }, 0.0, bound));
        }
        Worst { deviation: Tolerance { max: beyond, rms: 0.0 }, ..worst }
    }

    fn wrong(&self, fault: Fault, width: usize) -> Vec<u32> {
        let count = self.targets.len() / width;
        let nearest = || self.nearest.iter().map(|[first, _]| first.0);
        let used = match fault {
            Fault::LastChannels => width - 4,
            _ => width,
        };
        let least = |targets: usize, score: &dyn Fn(&[f64], &[f64]) -> f64| -> Vec<u32> {
            let of = |point: &[f64]| {
                let scores = self.targets.chunks(width).take(targets).map(|target| score(point, target));
                let best =
                    scores.enumerate().fold((0, f64::INFINITY), |best, (t, s)| if s < best.1 { (t, s) } else { best });
                best.0 as u32
            };
            self.points.chunks(width).map(of).collect()
        };
        let single = |x: f64| f64::from(x as f32);
        match fault {
            Fault::First => vec![0; self.nearest.len()],
            Fault::SecondNearest => self.nearest.iter().map(|[_, second]| second.0).collect(),
            Fault::LaterOfTwo => self.nearest.iter().map(|[first, second]| first.0.max(second.0)).collect(),
            Fault::NextIndex => nearest().map(|target| target + 1).collect(),
            Fault::LastOfEqual => {
                let rows: Vec<&[f64]> = self.targets.chunks(width).collect();
                nearest()
                    .map(|first| (0..count).rev().find(|&t| rows[t] == rows[first as usize]).unwrap_or(0) as u32)
                    .collect()
            }
            Fault::Folded => {
                let nearest: Vec<u32> = nearest().collect();
                (0..nearest.len()).map(|i| nearest[i % (GROUP_FOLD * NEAREST_ROWS) as usize]).collect()
            }
            Fault::Products => least(count, &|point, target| {
                let pairs = || point.iter().zip(target);
                let squares = pairs().fold(0.0, |sum, (_, t)| single(sum + t * t));
                squares - 2.0 * pairs().fold(0.0, |sum, (p, t)| single(sum + p * t))
            }),
            Fault::HalfSum => least(count, &|point, target| {
                point.iter().zip(target).fold(0.0, |sum, (p, t)| half(sum + (p - t).powi(2)))
            }),
            Fault::LastTarget | Fault::LastChannels => {
                let looked_at = if used == width { count - 1 } else { count };
                least(looked_at, &|p, t| p[..used].iter().zip(&t[..used]).map(|(p, t)| (p - t).powi(2)).sum())
            }
        }
    }
}

pub fn host_origin(mode: Mode, targets: &[f32], width: usize) -> Option<Vec<f32>> {
    let count = targets.len() / width;
    mode.matrix.then(|| origin(&widen(targets), width, count.min(64)).into_iter().map(|x| x as f32).collect())
}

impl case::Problem for Problem {
    type Output = Chosen;
    type Truth = Truth;
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Chosen> {
        let mut trial = Trial::new(device);
        let [from, to] =
            [&self.points, &self.targets].map(|x| Rows::new(trial.input(x), x.len() / self.width, self.width));
        let nearest = Nearest::among(&mut trial.rec, kernel(mode, device), to);
        let rows = [from, to].map(|rows| nearest.rows(&mut trial.rec, rows));
        let out = trial.output::<u32>(from.count);
        nearest.record_into(&mut trial.rec, rows[0], rows[1], out);
        let origin = nearest.origin();
        origin.into_iter().for_each(|origin| trial.rec.output(origin));
        let run = trial.run()?;
        Ok(Chosen { targets: run.read(out)?, origin: origin.map(|origin| run.read(origin)).transpose()? })
    }

    fn truth(&self, _: Mode) -> Truth {
        Truth::new(&self.points, &self.targets, self.width)
    }

    fn judge(&self, truth: &Truth, output: &Chosen, _: Mode) -> Worst {
        truth.excess(output, self.width)
    }

    /// Half of the bound on matrix units: reaching it deserves a look.
    fn typical(&self, _: &Device, _: Mode) -> Tolerance {
        Tolerance { max: 0.5, ..Tolerance::ANY }
    }

    fn faulty(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Chosen> {
        let origin = host_origin(mode, &self.targets, self.width);
        vec![Chosen { targets: truth.wrong(fault, self.width), origin }]
    }
}

/// Spreads and offsets cancel.
pub fn shapes() -> Area {
    let make = |width: usize| {
        move || {
            let values = |seed, rows: usize| Noise::new(seed).values(rows * width);
            let (points, targets) = (values(10, 67), values(11, 300));
            let problem =
                |points: &[f32], targets: &[f32]| Problem { width, points: points.to_vec(), targets: targets.to_vec() };
            let moved = |values: &[f32], scale: f32, by: f32| values.iter().map(|x| by + scale * x).collect::<Vec<_>>();
            let mut all = vec![problem(&points[..width], &targets)];
            for (scale, by) in [(1.0, 0.0), (1.0, 1e3), (1e-6, 0.0), (1e-3, 5.0), (1e15, 0.0), (1e-15, 0.0)] {
                all.push(problem(&moved(&points, scale, by), &moved(&targets, scale, by)));
            }
            // A thousandth as wide as the gaps between them.
            let clustered = |seed| {
                let of = |(i, noise): (usize, f32)| targets[i / width / 30 * width + i % width] + 1e-3 * noise;
                Noise::new(seed).values(targets.len()).into_iter().enumerate().map(of).collect::<Vec<_>>()
            };
            all.push(problem(&clustered(12), &clustered(13)));
            let middle = |pair: &[f32]| (0..width).map(|c| 0.5 * (pair[c] + pair[width + c])).collect::<Vec<_>>();
            let midway: Vec<f32> = targets.chunks_exact(2 * width).flat_map(middle).collect();
            all.push(problem(&midway, &targets));
            all.push(problem(&points, &[&targets[..], &targets].concat()));
            all
        }
    };
    let mut area = Area { cases: Vec::new(), ..area() };
    for width in [4, 12, 36, 100, 384] {
        area.sweep("spreads and offsets", width, [Fault::First], make(width));
    }
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("cluster/nearest", "channels", Mode::NEAREST, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, shape: [usize; 3], value: fn(f32) -> f32| {
        let make = move || {
            let [points, targets, width] = shape;
            let mut noise = Noise::new((points + targets + width) as u64);
            let mut rows = |count: usize| noise.values(count * width).into_iter().map(value).collect::<Vec<f32>>();
            let (points, mut targets) = (rows(points), rows(targets));
            let last = targets.len() - width;
            targets[last..].copy_from_slice(&points[..width]);
            Problem { width, points, targets }
        };
        area.add(name, shape[2], catches, make);
    };
    let any = || Catches::from([First, SecondNearest, NextIndex, LastTarget]);
    for width in [4, 64, 384, 1536] {
        let random = if width > 64 { any().and(&[HalfSum]) } else { any() };
        add("random", random.and(&[LastChannels]), [65, 333, width], |r| r);
        add("mean 1e4, spread 1", any().and(&[Products]), [65, 333, width], |r| 1e4 + r);
    }
    add("near ties: spread of a few units in the last place", any(), [65, 333, 64], |r| 1.0 + 4e-7 * (4.0 * r).round());
    add("duplicates", [First, LastOfEqual].into(), [65, 333, 4], f32::round);
    add("one target", [NextIndex].into(), [65, 1, 64], |r| r);
    add("values of 1e15", any(), [33, 100, 64], |r| 1e15 * r);
    add("values of 1e-15", any(), [33, 100, 64], |r| 1e-15 * r);
    let folded = (GROUP_FOLD * NEAREST_ROWS) as usize + 9;
    add("points beyond a fold of workgroups", [First, Folded].into(), [folded, 5, 4], |r| r);
    let midway = || {
        const WIDTH: usize = 64;
        let targets = Noise::new(7).values(100 * WIDTH);
        let row = |index: usize| targets.chunks(WIDTH).nth(index % 100).unwrap_or_default();
        let midway = |i: usize| row(i).iter().zip(row(3 * i + 1)).map(|(a, b)| 0.5 * (a + b)).collect::<Vec<f32>>();
        let points = (0..65).flat_map(midway).collect();
        Problem { width: WIDTH, points, targets }
    };
    area.add("points midway between two targets", 64, [First, NextIndex, LaterOfTwo], midway);
    area
}
