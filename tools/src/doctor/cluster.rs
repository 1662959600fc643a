//! Clustering: the nearest target, and k-means as a whole.

use super::{Area, Case, Mode, Worst, bound::gamma, trial::Trial};
use crate::noise::Noise;
use zipsplat::{
    Result,
    gpu::Device,
    kernels::{cluster::Nearest, limits::NEAREST_ROWS},
    stages::cluster,
};
use zipsplat_reference::{
    cluster::{kmeans::kmeans as reference_kmeans, nearest::two_nearest},
    widen,
};

const NEAREST: &str = "a squared distance is a sum of w squares without cancellation, off by gamma_(w+3) of itself at most; \
    what is chosen may so be farther than the nearest by 2 gamma_(w+3) / (1 - gamma_(w+3)), relatively, and no more";

const KMEANS: &str = "coordinates are whole multiples of 2^-6 whose squared distances f32 holds exactly, and clusters have a \
    power of two of members, so that every mean and every tie is as in f64: assignments must be equal. The nearest tokens \
    then as in cluster/nearest";

/// How much farther, relatively, the chosen targets are than the nearest, in squared distance.
fn check_nearest(device: &Device, points: &[f32], targets: &[f32], width: usize) -> Result<Worst> {
    let count = points.len() / width;
    let mut trial = Trial::new(device);
    let out = trial.output::<u32>(count);
    let kernel = Nearest {
        points: trial.input(points),
        targets: trial.input(targets),
        out,
        point_count: count as u32,
        target_count: (targets.len() / width) as u32,
        width: width as u32,
    };
    trial.rec.dispatch_groups(kernel, count.div_ceil(NEAREST_ROWS as usize));
    let chosen: Vec<u32> = trial.result(out)?;
    Ok(excess(&chosen, points, targets, width))
}

fn excess(chosen: &[u32], points: &[f32], targets: &[f32], width: usize) -> Worst {
    let (points, targets) = (widen(points), widen(targets));
    let slack = gamma(width + 3);
    let mut worst = Worst::NONE;
    for ((point, &index), [(first, nearest), _]) in
        points.chunks(width).zip(chosen).zip(two_nearest(&points, &targets, width))
    {
        let Some(target) = targets.chunks(width).nth(index as usize) else {
            return Worst::one(f64::NAN, 0.0, 0.0);
        };
        let squared = point.iter().zip(target).map(|(p, t)| (p - t).powi(2)).sum::<f64>();
        let nearest = nearest * nearest;
        // Of equal targets the first; squares below 2^-126 may be flushed.
        let equal = index != first && target == &targets[first as usize * width..][..width];
        let farther = if equal { f64::INFINITY } else { (squared - nearest) / nearest.max(1e-30) };
        worst = worst.or(Worst::one(farther.max(0.0), 0.0, 2.0 * slack / (1.0 - slack)));
    }
    worst
}

pub fn nearest() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, [points, targets, width]: [usize; 3], value: fn(f32) -> f32| {
        cases.push(Case::new(name, width, move |device, _| {
            let mut noise = Noise((points + targets + width) as u64);
            let [points, targets] =
                [points, targets].map(|count| noise.values(count * width).into_iter().map(value).collect::<Vec<f32>>());
            check_nearest(device, &points, &targets, width)
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
    Area { kernel: "cluster/nearest", size: "channels", reason: NEAREST, modes: Mode::ONLY_EXACT, cases }
}

/// Nearest tokens of k-means and the final assignment.
fn cluster_on(device: &Device, x: &[f32], width: usize, k: usize) -> Result<[Vec<u32>; 2]> {
    let count = x.len() / width;
    let mut trial = Trial::new(device);
    trial.rec = trial.rec.observing();
    let (tokens, initial) = (trial.input(x), trial.input(&cluster::even_indices(count, k)));
    let nearest = cluster::record(&mut trial.rec, tokens, initial, [count, k, width], cluster::ROUNDS);
    trial.rec.output(nearest);
    let run = trial.run()?;
    let assigned = run.observed().iter().find(|(name, _)| name.ends_with("assign")).map(|(_, tensor)| *tensor);
    Ok([run.read(nearest)?, assigned.map(|tensor| run.read(tensor)).transpose()?.unwrap_or_default()])
}

fn check_kmeans(device: &Device, x: &[f32], width: usize, k: usize) -> Result<Worst> {
    let [chosen, assigned] = cluster_on(device, x, width, k)?;
    let truth = reference_kmeans(&widen(x), width, k);
    let last = truth.assignments.last().map(Vec::as_slice).unwrap_or_default();
    let assignments = Worst::differing(&assigned, last);
    let centroids: Vec<f32> = truth.centroids.iter().map(|&c| c as f32).collect();
    Ok(assignments.or(excess(&chosen, &centroids, x, width)))
}

pub fn kmeans() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, count: usize, k: usize, value: fn(usize, f32) -> f32| {
        const WIDTH: usize = 8;
        cases.push(Case::new(name, count, move |device, _| {
            let noise = Noise(count as u64).values(count * WIDTH);
            let x: Vec<f32> =
                noise.into_iter().enumerate().map(|(i, r)| value(i / WIDTH, (r * 64.0).round() / 64.0)).collect();
            let worst = check_kmeans(device, &x, WIDTH, k)?;
            let again = [0; 2].map(|_| cluster_on(device, &x, WIDTH, k));
            let [first, second] = again;
            Ok(worst.or(Worst::differing(&first?.concat(), &second?.concat())))
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
    Area { kernel: "cluster", size: "tokens", reason: KMEANS, modes: Mode::ONLY_EXACT, cases }
}
