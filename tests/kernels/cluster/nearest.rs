//! The nearest target, exactly.
//!
//! Coordinates are small whole numbers or multiples of 1/64, whose squared distances f32 holds exactly, so that f32 and
//! f64 agree on every tie.

use crate::case::{Case, random, random_below};
use zipsplat::kernels::{cluster::Nearest, limits::NEAREST_ROWS};
use zipsplat_tests::compare::assert_same;
use zipsplat_tests::reference::{cluster::nearest::two_nearest, widen};

fn nearest(points: &[f32], targets: &[f32], width: usize) -> Vec<u32> {
    let count = points.len() / width;
    let mut case = Case::new();
    let out = case.output::<u32>(count);
    let kernel = Nearest {
        points: case.input(points),
        targets: case.input(targets),
        out,
        point_count: count as u32,
        target_count: (targets.len() / width) as u32,
        width: width as u32,
    };
    case.rec.dispatch_groups(kernel, count.div_ceil(NEAREST_ROWS as usize));
    case.result(out)
}

fn truth(points: &[f32], targets: &[f32], width: usize) -> Vec<u32> {
    two_nearest(&widen(points), &widen(targets), width).iter().map(|[first, _]| first.0).collect()
}

fn check(name: &str, points: &[f32], targets: &[f32], width: usize) {
    assert_same(name, &nearest(points, targets, width), &truth(points, targets, width));
}

/// Multiples of 1/64 around `offset`.
fn quantised(seed: u64, len: usize, offset: f32) -> Vec<f32> {
    random(seed, len).iter().map(|x| offset + (x * 64.0).round() / 64.0).collect()
}

#[test]
fn equals_the_reference() {
    for points in [0, 1, 7, 8, 9, 65] {
        // A subgroup of 8 looks at 32 targets at a time, one of 64 at 256.
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
    // Few places for many targets: nearly every distance is that of several.
    let places = |seed, len| random_below(seed, len, 3).iter().map(|&x| x as f32).collect::<Vec<_>>();
    for targets in [40, 300, 2000] {
        check(&format!("{targets} targets"), &places(3, 100 * 4), &places(4, targets * 4), 4);
    }
}

#[test]
fn duplicates_and_points_among_the_targets() {
    let once = quantised(5, 150 * 8, 0.0);
    let twice = [once.clone(), once.clone()].concat();
    let own: Vec<u32> = (0..150).collect();
    assert_same("themselves", &nearest(&once, &twice, 8), &own);
    assert_same("all equal", &nearest(&once, &[1.0; 8 * 90], 8), &[0; 150]);
}

#[test]
fn far_from_the_origin() {
    // |p|^2 - 2 p t + |t|^2 would be off by 1e8 * 64 times the rounding of f32: hundreds of these squared distances.
    check("offset 1e4", &quantised(6, 90 * 64, 1e4), &quantised(7, 200 * 64, 1e4), 64);
}

#[test]
fn a_permutation_permutes() {
    let (width, points, targets) = (36, 150, 301);
    let (from, to) = (random(8, points * width), random(9, targets * width));
    let rows = |values: &[f32], order: &[usize]| -> Vec<f32> {
        order.iter().flat_map(|i| &values[i * width..][..width]).copied().collect()
    };
    let plain = nearest(&from, &to, width);
    let order: Vec<usize> = (0..points).map(|i| i * 7 % points).collect();
    let moved: Vec<u32> = order.iter().map(|i| plain[*i]).collect();
    assert_same("points", &nearest(&rows(&from, &order), &to, width), &moved);
    let order: Vec<usize> = (0..targets).map(|i| i * 11 % targets).collect();
    let found = nearest(&from, &rows(&to, &order), width);
    assert_same("targets", &found.iter().map(|i| order[*i as usize] as u32).collect::<Vec<_>>(), &plain);
}

#[test]
fn points_beyond_the_most_workgroups() {
    let count = 65_536 * NEAREST_ROWS as usize + 1;
    assert_same("one target", &nearest(&vec![0.5; count * 4], &[0.25; 4], 4), &vec![0; count]);
    // The first target for the first row of folded workgroups, the second for those behind.
    let fold = 4 * 32_768 * NEAREST_ROWS as usize;
    let points: Vec<f32> = (0..count * 4).map(|i| if i < fold { 0.0 } else { 1.0 }).collect();
    check("two targets", &points, &[0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0], 4);
}
