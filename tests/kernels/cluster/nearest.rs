//! The nearest target, and the first in a tie.
//!
//! Most coordinates are small integers or multiples of 1/64 about an origin. Their squared
//! distances and the products of their halves are exact in f32, so every kernel agrees with f64.

use crate::case::{Case, nearest_kernels, random, random_below, with_and_without_addresses};
use zipsplat::{
    gpu::Limits,
    kernels::limits::NEAREST_ROWS,
    ops::{Nearest, NearestKernel, Rows, Tile, Tiles, Units},
};
use zipsplat_tests::compare::assert_same;
use zipsplat_tests::device::device;
use zipsplat_tests::reference::{
    cluster::nearest::{TIE, error_of_products, nearest as reference, two_nearest},
    widen,
};

/// Returns the nearest rows and the origin, given or computed by the kernel.
fn find(
    limits: &Limits,
    kernel: NearestKernel,
    [points, targets]: [&[f32]; 2],
    width: usize,
    about: Option<f32>,
) -> (Vec<u32>, Vec<f32>) {
    let mut case = Case::within(limits);
    let [points, targets] = [points, targets].map(|rows| Rows::new(case.input(rows), rows.len() / width, width));
    let nearest = match (kernel, about) {
        (NearestKernel::Matrix(units), Some(x)) => Nearest::about(case.input(&vec![x; width]), units, width),
        _ => Nearest::among(&mut case.rec, kernel, targets),
    };
    let rows = [points, targets].map(|rows| nearest.rows(&mut case.rec, rows));
    let out = case.output::<u32>(points.count);
    nearest.record_into(&mut case.rec, rows[0], rows[1], out);
    nearest.origin().into_iter().for_each(|origin| case.rec.output(origin));
    let run = case.run();
    (run.read(out).unwrap(), nearest.origin().map_or(Vec::new(), |origin| run.read(origin).unwrap()))
}

fn nearest(kernel: NearestKernel, points: &[f32], targets: &[f32], width: usize) -> Vec<u32> {
    find(device().limits(), kernel, [points, targets], width, Some(0.0)).0
}

/// Checks coordinates about `origin` for which every kernel is exact.
fn check_about(origin: f32, name: &str, points: &[f32], targets: &[f32], width: usize) {
    let truth = reference(&widen(points), &widen(targets), width);
    for kernel in nearest_kernels() {
        for limits in with_and_without_addresses(device().limits(), kernel == NearestKernel::Lanes) {
            let (found, _) = find(&limits, kernel, [points, targets], width, Some(origin));
            assert_same(&format!("{name} {kernel:?}"), &found, &truth);
        }
    }
}

fn check(name: &str, points: &[f32], targets: &[f32], width: usize) {
    check_about(0.0, name, points, targets, width);
}

/// Checks any coordinates on matrix units and returns the largest share of the error bound.
///
/// The result is farther than the nearest by at most the bound and a tie; the first of equal
/// targets wins.
fn check_bound(name: &str, points: &[f32], targets: &[f32], width: usize) -> f64 {
    let matrix = nearest_kernels().into_iter().filter(|kernel| *kernel != NearestKernel::Lanes);
    matrix.map(|kernel| check_bound_of(device().limits(), kernel, name, [points, targets], width)).fold(0.0, f64::max)
}

fn check_bound_of(
    limits: &Limits,
    kernel: NearestKernel,
    name: &str,
    [points, targets]: [&[f32]; 2],
    width: usize,
) -> f64 {
    let (wide_points, wide_targets) = (widen(points), widen(targets));
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let (found, origin) = find(limits, kernel, [points, targets], width, None);
    let origin = widen(&origin);
    let truth = two_nearest(&wide_points, &wide_targets, width);
    let mut worst: f64 = 0.0;
    for (i, (point, [(first, least), _])) in wide_points.chunks(width).zip(truth).enumerate() {
        let target = |index: u32| &wide_targets[index as usize * width..][..width];
        let bound = |index| error_of_products([point, target(index)].map(|row| distance(row, &origin)), width);
        let farther = distance(point, target(found[i])).powi(2) - least.powi(2) * (1.0 + TIE);
        let share = farther / (bound(first) + bound(found[i]));
        assert!(share <= 1.0, "{name}: point {i} has {}, {share} bounds farther than {first}", found[i]);
        let twin = wide_targets.chunks(width).position(|other| other == target(found[i]));
        assert_eq!(twin, Some(found[i] as usize), "{name}: point {i}, of equal targets the first");
        worst = worst.max(share);
    }
    worst
}

/// Returns multiples of 1/64 around `offset`.
fn quantised(seed: u64, len: usize, offset: f32) -> Vec<f32> {
    random(seed, len).iter().map(|x| offset + (x * 64.0).round() / 64.0).collect()
}

#[test]
fn equals_the_reference() {
    for points in [0, 1, 7, 8, 9, 65] {
        // Subgroups of 8 and of 64 process 32 and 256 targets at a time.
        for targets in [1, 2, 3, 31, 32, 33, 127, 129, 255, 257, 1000] {
            for width in [4, 36] {
                let name = format!("{points} points, {targets} targets, {width}");
                check(&name, &quantised(1, points * width, 0.0), &quantised(2, targets * width, 0.0), width);
            }
        }
    }
}

#[test]
fn of_equally_near_ones_the_first() {
    // Many targets share few coordinates, so nearly every distance ties.
    let places = |seed, len| random_below(seed, len, 3).iter().map(|&x| x as f32).collect::<Vec<_>>();
    for targets in [40, 300, 2000] {
        check(&format!("{targets} targets"), &places(3, 100 * 4), &places(4, targets * 4), 4);
    }
}

/// Permutes the channels of rows, and so the order of sums.
fn reordered(rows: &[f32], width: usize, step: usize) -> Vec<f32> {
    rows.chunks(width).flat_map(|row| (0..width).map(|c| row[(c * step + step) % width])).collect()
}

/// Points midway between two targets, like the mean of a cluster of two.
#[test]
fn rounding_does_not_choose() {
    assert_eq!(TIE, f64::from(Nearest::TIE));
    let count = 200;
    for width in [100, 384, 1536] {
        let targets = random(18, count * width);
        let pairs: Vec<[usize; 2]> = (0..count).map(|i| [i, (i * 7 + 3) % count]).filter(|[a, b]| a != b).collect();
        let first: Vec<u32> = pairs.iter().map(|pair| pair[0].min(pair[1]) as u32).collect();
        for round in 0..4 {
            // Rounded inputs, and a rounded mean.
            let noise = random(19 + round, targets.len());
            let targets: Vec<f32> =
                targets.iter().zip(noise).map(|(x, noise)| x + 1e-6 * round as f32 * noise).collect();
            let targets = reordered(&targets, width, [1, 7, 11, 13][round as usize]);
            let row = |index: usize| &targets[index * width..][..width];
            let midway =
                |[a, b]: &[usize; 2]| row(*a).iter().zip(row(*b)).map(|(a, b)| (a + b) / 2.0).collect::<Vec<_>>();
            let points: Vec<f32> = pairs.iter().flat_map(midway).collect();
            for kernel in nearest_kernels() {
                let name = format!("{width} channels, round {round}, {kernel:?}");
                assert_same(&name, &find(device().limits(), kernel, [&points, &targets], width, None).0, &first);
            }
        }
    }
}

/// Targets on every lane, equally far from a point.
#[test]
fn of_many_that_tie_the_first() {
    let (width, count) = (64, 3000);
    let point: Vec<f32> = random(20, width).iter().map(|x| 4.0 + x).collect();
    // Signs change the rounding, not the distance.
    let apart = random(21, width);
    let target = |i: usize| -> Vec<f32> {
        let (size, signs) = (if i % 29 == 17 { 1.0 } else { 1.5 }, random(100 + i as u64, width));
        (0..width).map(|c| point[c] + size * apart[c].copysign(signs[c])).collect()
    };
    let targets: Vec<f32> = (0..count).flat_map(target).collect();
    let (found, _) = find(device().limits(), NearestKernel::Lanes, [&point, &targets], width, None);
    assert_same("lanes", &found, &[17]);
}

#[test]
fn duplicates_and_points_among_the_targets() {
    let once = quantised(5, 150 * 8, 0.0);
    let twice = [once.clone(), once.clone()].concat();
    let own: Vec<u32> = (0..150).collect();
    for kernel in nearest_kernels() {
        assert_same("themselves", &nearest(kernel, &once, &twice, 8), &own);
        assert_same("all equal", &nearest(kernel, &once, &[1.0; 8 * 90], 8), &[0; 150]);
    }
}

#[test]
fn far_from_the_origin() {
    // p|^2 - 2 p t + |t|^2 would be off by 1e8 * 64 f32 roundings, hundreds of times the distance.
    check_about(1e4, "offset 1e4", &quantised(6, 90 * 64, 1e4), &quantised(7, 200 * 64, 1e4), 64);
}

#[test]
fn matrix_units_stay_within_their_bound() {
    let mut worst: f64 = 0.0;
    let mut within = |name: &str, points: &[f32], targets: &[f32], width: usize| {
        worst = worst.max(check_bound(&format!("{name}, {width}"), points, targets, width));
    };
    for width in [4, 12, 36, 100, 384] {
        let (points, targets) = (random(10, 67 * width), random(11, 300 * width));
        let moved = |values: &[f32], scale: f32, by: f32| values.iter().map(|x| by + scale * x).collect::<Vec<_>>();
        within("random", &points, &targets, width);
        within("one target", &points, &targets[..width], width);
        within("one point", &points[..width], &targets, width);
        for (scale, by) in [(1.0, 1e3), (1e-6, 0.0), (1e-3, 5.0), (1e15, 0.0), (1e-15, 0.0)] {
            let name = format!("spread {scale:e} about {by:e}");
            within(&name, &moved(&points, scale, by), &moved(&targets, scale, by), width);
        }
        // Clusters a thousandth as wide as the gaps between them, and points midway between two
        // targets.
        let clustered: Vec<f32> = (0..targets.len()).map(|i| targets[i / width / 30 * width + i % width]).collect();
        let jittered = |seed| -> Vec<f32> {
            let jitter = random(seed, clustered.len());
            clustered.iter().zip(jitter).map(|(x, j)| x + 1e-3 * j).collect()
        };
        within("clusters", &jittered(12), &jittered(13), width);
        let midway: Vec<f32> =
            targets.chunks_exact(2 * width).flat_map(|t| (0..width).map(|c| 0.5 * (t[c] + t[width + c]))).collect();
        within("midway", &midway, &targets, width);
        let twice = [&targets[..], &targets[..]].concat();
        within("duplicates", &points, &twice, width);
    }
    assert!(worst < 0.5, "a bound that is nearly reached deserves a look: {worst}");
}

#[test]
fn a_permutation_permutes() {
    let (width, points, targets) = (36, 150, 301);
    let (from, to) = (random(8, points * width), random(9, targets * width));
    let rows = |values: &[f32], order: &[usize]| -> Vec<f32> {
        order.iter().flat_map(|i| &values[i * width..][..width]).copied().collect()
    };
    for kernel in nearest_kernels() {
        let plain = nearest(kernel, &from, &to, width);
        let order: Vec<usize> = (0..points).map(|i| i * 7 % points).collect();
        let moved: Vec<u32> = order.iter().map(|i| plain[*i]).collect();
        assert_same("points", &nearest(kernel, &rows(&from, &order), &to, width), &moved);
        let order: Vec<usize> = (0..targets).map(|i| i * 11 % targets).collect();
        let found = nearest(kernel, &from, &rows(&to, &order), width);
        assert_same("targets", &found.iter().map(|i| order[*i as usize] as u32).collect::<Vec<_>>(), &plain);
    }
}

#[test]
fn what_is_no_number_is_never_nearest() {
    // Nor does it affect other points.
    let (width, mut points, mut targets) = (8, quantised(14, 40 * 8, 0.0), quantised(15, 70 * 8, 0.0));
    let truth = reference(&widen(&points), &widen(&targets[8..]), width);
    (points[3 * 8 + 5], targets[2]) = (f32::NAN, f32::INFINITY);
    for kernel in nearest_kernels() {
        let found = nearest(kernel, &points, &targets, width);
        assert_eq!(found[3], 0, "{kernel:?}");
        let others = (0..40).filter(|i| *i != 3);
        assert!(others.clone().all(|i| found[i] == truth[i] + 1), "{kernel:?}: {found:?}");
    }
}

#[test]
fn tiles_of_gpus() {
    // CPUs get smaller tiles, which compile faster.
    let limits = Limits { cpu: false, ..device().limits().clone() };
    let [points, targets] = [(16, 150), (17, 700)].map(|(seed, rows)| random(seed, rows * 100));
    for kernel in nearest_kernels() {
        let NearestKernel::Matrix(units) = kernel else { continue };
        let tiles = Tile::nearest(&limits, units);
        assert!(!tiles.is_empty());
        for (index, tile) in tiles.iter().enumerate() {
            let kernel = NearestKernel::Matrix(Units { tiles: Tiles::always(index), ..units });
            check_bound_of(&limits, kernel, &format!("{tile:?}"), [&points, &targets], 100);
        }
    }
}

#[test]
fn points_beyond_the_most_workgroups() {
    let count = 65_536 * NEAREST_ROWS as usize + 1;
    // The first target for the first row of folded workgroups, the second for the rest.
    let fold = 4 * 32_768 * NEAREST_ROWS as usize;
    let points: Vec<f32> = (0..count * 4).map(|i| if i < fold { 0.0 } else { 1.0 }).collect();
    for kernel in nearest_kernels() {
        assert_same("one target", &nearest(kernel, &vec![0.5; count * 4], &[0.25; 4], 4), &vec![0; count]);
    }
    check("two targets", &points, &[0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0], 4);
}
