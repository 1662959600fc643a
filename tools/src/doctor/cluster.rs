//! Clustering: the nearest target, and k-means as a whole.

use super::{Area, Case, Mode, Worst, bound::gamma, trial::Trial};
use crate::noise::Noise;
use zipsplat::{
    Result,
    gpu::{Device, Tensor},
    ops::{Nearest, NearestKernel},
    stages::cluster,
};
use zipsplat_reference::{
    cluster::{
        kmeans::kmeans as reference_kmeans,
        nearest::{TIE, error_of_products, two_nearest},
    },
    widen,
};

const NEAREST: &str = "a squared distance is a sum of w squares without cancellation, off by gamma_(w+3) of itself at most; \
    what is chosen may so be farther than the nearest by 2 gamma_(w+3) / (1 - gamma_(w+3)), relatively, and by the 2^-16 within \
    which targets tie, and no more. On matrix units it is |t|^2 - 2 p t about an origin, of two f16 for each value, off by what \
    kernels/cluster/nearest_matrix.comp derives; what is chosen may be farther by that of both, and by a tie. Of two targets \
    that only rounding tells apart it must be the first";

const KMEANS: &str = "coordinates are whole multiples of 2^-6 whose squared distances f32 holds exactly, and clusters have a \
    power of two of members, so that every mean and every tie is as in f64: assignments must be equal. The nearest tokens \
    then as in cluster/nearest";

/// What finds nearest rows in a mode.
fn kernel(mode: Mode, device: &Device) -> NearestKernel {
    mode.units(device).map_or(NearestKernel::Lanes, NearestKernel::Matrix)
}

/// How much farther the chosen targets are than the nearest.
fn check_nearest(device: &Device, mode: Mode, points: &[f32], targets: &[f32], width: usize) -> Result<Worst> {
    let mut trial = Trial::new(device);
    let [from, to] = [points, targets].map(|rows| (trial.input(rows), rows.len() / width));
    let nearest = Nearest::among(&mut trial.rec, kernel(mode, device), to, width);
    let rows = [from, to].map(|rows| nearest.rows(&mut trial.rec, rows));
    let out = trial.output::<u32>(from.1);
    nearest.record_into(&mut trial.rec, rows[0], rows[1], out);
    let origin = nearest.origin();
    origin.into_iter().for_each(|origin| trial.rec.output(origin));
    let run = trial.run()?;
    let origin: Option<Vec<f32>> = origin.map(|origin| run.read(origin)).transpose()?;
    Ok(excess(&run.read::<u32>(out)?, points, targets, origin.as_deref(), width))
}

fn squared(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

/// In squared distance.
fn excess(chosen: &[u32], points: &[f32], targets: &[f32], origin: Option<&[f32]>, width: usize) -> Worst {
    let (points, targets, origin) = (widen(points), widen(targets), origin.map(widen));
    let slack = 2.0 * gamma(width + 3) / (1.0 - gamma(width + 3));
    let mut worst = Worst::NONE;
    for ((point, &index), [(first, nearest), (second, next)]) in
        points.chunks(width).zip(chosen).zip(two_nearest(&points, &targets, width))
    {
        let Some(target) = targets.chunks(width).nth(index as usize) else {
            return Worst::one(f64::NAN, 0.0, 0.0);
        };
        let best = &targets[first as usize * width..][..width];
        let [nearest, next] = [nearest, next].map(|distance| distance * distance);
        let farther = (squared(point, target) - nearest).max(0.0);
        // Squares below 2^-126 may be flushed.
        let tie = TIE * nearest.max(1e-30);
        let bound = match &origin {
            None => tie + slack * nearest.max(1e-30),
            Some(origin) => {
                let error = |row| error_of_products([point, row].map(|row| squared(row, origin).sqrt()), width);
                tie + error(target) + error(best)
            }
        };
        let alone = || targets.chunks(width).filter(|row| squared(point, row) <= nearest + 2.0 * bound).count() == 2;
        let tied = index > second && next * (1.0 + slack) <= nearest * (1.0 + TIE) && alone();
        let later = index > first && target == best || tied;
        worst = worst.or(Worst::one(if later { f64::INFINITY } else { farther }, 0.0, bound));
    }
    worst
}

pub fn nearest() -> Area {
    const WIDE: usize = 64;
    let mut cases = Vec::new();
    let mut add = |name: &str, [points, targets, width]: [usize; 3], value: fn(f32) -> f32| {
        cases.push(Case::new(name, width, move |device, mode| {
            let mut noise = Noise((points + targets + width) as u64);
            let [points, targets] =
                [points, targets].map(|count| noise.values(count * width).into_iter().map(value).collect::<Vec<f32>>());
            check_nearest(device, mode, &points, &targets, width)
        }));
    };
    for width in [4, 64, 384, 1536] {
        add("random", [65, 333, width], |r| r);
        add("mean 1e4, spread 1", [65, 333, width], |r| 1e4 + r);
    }
    add("near ties: spread of a few units in the last place", [65, 333, 64], |r| 1.0 + 4e-7 * (4.0 * r).round());
    add("duplicates", [65, 333, 4], f32::round);
    add("one target", [65, 1, 64], |r| r);
    add("values of 1e15", [33, 100, 64], |r| 1e15 * r);
    add("values of 1e-15", [33, 100, 64], |r| 1e-15 * r);
    cases.push(Case::new("points midway between two targets", WIDE, |device, mode| {
        let targets = Noise(7).values(100 * WIDE);
        let row = |index: usize| targets.chunks(WIDE).nth(index % 100).unwrap_or_default();
        let midway = |i: usize| row(i).iter().zip(row(3 * i + 1)).map(|(a, b)| 0.5 * (a + b)).collect::<Vec<f32>>();
        check_nearest(device, mode, &(0..65).flat_map(midway).collect::<Vec<f32>>(), &targets, WIDE)
    }));
    Area { kernel: "cluster/nearest", size: "channels", reason: NEAREST, modes: Mode::NEAREST, cases }
}

/// What k-means finds.
struct Found {
    nearest: Vec<u32>,
    /// The final assignment.
    assigned: Vec<u32>,
}

impl Found {
    fn all(self) -> Vec<u32> {
        [self.nearest, self.assigned].concat()
    }
}

fn cluster_on(device: &Device, mode: Mode, x: &[f32], width: usize, k: usize) -> Result<Found> {
    let count = x.len() / width;
    let mut trial = Trial::new(device);
    trial.rec = trial.rec.observing();
    let (tokens, initial) = (trial.input(x), trial.input(&cluster::even_indices(count, k)));
    let sizes = [count, k, width];
    let nearest = cluster::record(&mut trial.rec, kernel(mode, device), tokens, initial, sizes, cluster::ROUNDS);
    trial.rec.output(nearest);
    let run = trial.run()?;
    let observed = |what: &str| -> Option<Tensor> {
        run.observed().iter().find(|(name, _)| name.ends_with(what)).map(|(_, tensor)| *tensor)
    };
    let assigned = observed("assign").map(|tensor| run.read(tensor)).transpose()?.unwrap_or_default();
    Ok(Found { nearest: run.read(nearest)?, assigned })
}

/// About what matrix units compare.
fn origin_of(device: &Device, mode: Mode, x: &[f32], width: usize) -> Result<Option<Vec<f32>>> {
    let mut trial = Trial::new(device);
    let rows = (trial.input(x), x.len() / width);
    let Some(origin) = Nearest::among(&mut trial.rec, kernel(mode, device), rows, width).origin() else {
        return Ok(None);
    };
    trial.rec.output(origin);
    Ok(Some(trial.result(origin)?))
}

fn check_kmeans(device: &Device, mode: Mode, x: &[f32], width: usize, k: usize) -> Result<Worst> {
    let found = cluster_on(device, mode, x, width, k)?;
    let truth = reference_kmeans(&widen(x), width, k);
    let last = truth.assignments.last().map(Vec::as_slice).unwrap_or_default();
    let assignments = Worst::differing(&found.assigned, last);
    let centroids: Vec<f32> = truth.centroids.iter().map(|&c| c as f32).collect();
    let origin = origin_of(device, mode, x, width)?;
    Ok(assignments.or(excess(&found.nearest, &centroids, x, origin.as_deref(), width)))
}

pub fn kmeans() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, count: usize, k: usize, value: fn(usize, f32) -> f32| {
        const WIDTH: usize = 8;
        cases.push(Case::new(name, count, move |device, mode| {
            let noise = Noise(count as u64).values(count * WIDTH);
            let x: Vec<f32> =
                noise.into_iter().enumerate().map(|(i, r)| value(i / WIDTH, (r * 64.0).round() / 64.0)).collect();
            let worst = check_kmeans(device, mode, &x, WIDTH, k)?;
            let again = [0; 2].map(|_| cluster_on(device, mode, &x, WIDTH, k).map(Found::all));
            let [first, second] = again;
            Ok(worst.or(Worst::differing(&first?, &second?)))
        }));
    };
    // Blobs so far apart that no rounding moves a token between them, in runs of 16 tokens.
    for count in [64, 512, 4096] {
        add("blobs", count, count / 16, |token, r| (token / 16 * 8) as f32 + r);
        add("blobs around 1e4", count, count / 16, |token, r| 1e4 + (token / 16 * 8) as f32 + r);
    }
    add("K = 1", 64, 1, |_, r| r);
    add("K = N", 33, 33, |token, r| token as f32 + r);
    add("K = N - 1", 64, 63, |token, r| (4 * token) as f32 + r);
    add("duplicates, empty clusters", 128, 40, |token, _| (token % 4) as f32);
    add("all tokens equal", 64, 9, |_, _| 0.5);
    Area { kernel: "cluster", size: "tokens", reason: KMEANS, modes: Mode::NEAREST, cases }
}
