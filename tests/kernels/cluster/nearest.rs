//! Most coordinates are small integers or multiples of 1/64 about an origin: squared distances and
//! products of halves are exact in f32.

use crate::case::*;
use zipsplat::kernels::limits::NEAREST_ROWS;
use zipsplat::ops::{Nearest, NearestKernel, Tile, Tiles, Units};
use zipsplat_tests::reference::cluster::nearest::{TIE, nearest as reference};
use zipsplat_verify::{Chosen, NearestTruth};

/// Returns the nearest rows and the origin, given or computed by the kernel.
fn find(
    limits: &Limits,
    kernel: NearestKernel,
    [points, targets]: [&[f32]; 2],
    width: usize,
    about: Option<f32>,
) -> (Vec<u32>, Vec<f32>) {
    let mut case = plan_within(limits);
    let [points, targets] = [points, targets].map(|rows| Rows::new(case.input(rows), rows.len() / width, width));
    let nearest = match (kernel, about) {
        (NearestKernel::Matrix(units), Some(x)) => Nearest::about(case.input(&vec![x; width]), units, width),
        _ => Nearest::among(&mut case.rec, kernel, targets),
    };
    let rows = [points, targets].map(|rows| nearest.rows(&mut case.rec, rows));
    let out = case.output::<u32>(points.count);
    nearest.record_into(&mut case.rec, rows[0], rows[1], out);
    nearest.origin().into_iter().for_each(|origin| case.rec.output(origin));
    let run = case.run().unwrap();
    (run.read(out).unwrap(), nearest.origin().map_or(Vec::new(), |origin| run.read(origin).unwrap()))
}

fn nearest(kernel: NearestKernel, points: &[f32], targets: &[f32], width: usize) -> Vec<u32> {
    find(device().limits(), kernel, [points, targets], width, Some(0.0)).0
}

fn check(name: &str, points: &[f32], targets: &[f32], width: usize) {
    let truth = reference(&widen(points), &widen(targets), width);
    for kernel in nearest_kernels() {
        for limits in with_and_without_addresses(device().limits(), kernel == NearestKernel::Lanes) {
            let (found, _) = find(&limits, kernel, [points, targets], width, Some(0.0));
            assert_same(&format!("{name} {kernel:?}"), &found, &truth);
        }
    }
}

fn quantized(seed: u64, len: usize) -> Vec<f32> {
    random(seed, len).iter().map(|x| (x * 64.0).round() / 64.0).collect()
}

#[test]
fn equals_the_reference() {
    for points in [0, 1, 7, 8, 9, 65] {
        // Subgroups of 8 and of 64 process 32 and 256 targets at a time.
        for targets in [1, 2, 3, 31, 32, 33, 127, 129, 255, 257, 1000] {
            for width in [4, 36] {
                let name = format!("{points} points, {targets} targets, {width}");
                check(&name, &quantized(1, points * width), &quantized(2, targets * width), width);
            }
        }
    }
}

#[test]
fn of_equally_near_ones_the_first() {
    // Nearly every distance ties.
    let places = |seed, len| random_below(seed, len, 3).iter().map(|&x| x as f32).collect::<Vec<_>>();
    for targets in [40, 300, 2000] {
        check(&format!("{targets} targets"), &places(3, 100 * 4), &places(4, targets * 4), 4);
    }
}

fn reordered(rows: &[f32], width: usize, step: usize) -> Vec<f32> {
    rows.chunks(width).flat_map(|row| (0..width).map(|c| row[(c * step + step) % width])).collect()
}

/// Points midway between two targets.
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
fn what_is_no_number_is_never_nearest() {
    let (width, mut points, mut targets) = (8, quantized(14, 40 * 8), quantized(15, 70 * 8));
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
fn every_tile_finds_the_nearest() {
    let limits = device().limits();
    let [points, targets] = [(16, 150), (17, 700)].map(|(seed, rows)| random(seed, rows * 100));
    for kernel in nearest_kernels() {
        let NearestKernel::Matrix(units) = kernel else { continue };
        let tiles = Tile::nearest(limits, units);
        assert!(!tiles.is_empty());
        for (index, tile) in tiles.iter().enumerate() {
            let kernel = NearestKernel::Matrix(Units { tiles: Tiles::always(index), ..units });
            let (chosen, origin) = find(limits, kernel, [&points, &targets], 100, None);
            let chosen = Chosen { targets: chosen, origin: Some(origin) };
            let worst = NearestTruth::new(&points, &targets, 100).excess(&chosen, 100);
            assert!(worst.share <= 1.0, "{tile:?}: {worst:?}");
        }
    }
}

#[test]
fn points_beyond_the_most_workgroups() {
    let count = 65_536 * NEAREST_ROWS as usize + 1;
    // The first target for the first folded row, the second for the rest.
    let fold = 4 * 32_768 * NEAREST_ROWS as usize;
    let points: Vec<f32> = (0..count * 4).map(|i| if i < fold { 0.0 } else { 1.0 }).collect();
    for kernel in nearest_kernels() {
        assert_same("one target", &nearest(kernel, &vec![0.5; count * 4], &[0.25; 4], 4), &vec![0; count]);
    }
    check("two targets", &points, &[0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0], 4);
}
