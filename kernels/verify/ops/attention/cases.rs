use super::{
    Fault::{self, *},
    Problem,
};
use crate::prelude::*;
use zipsplat::{
    kernels::limits::ATTENTION_ROWS,
    ops::{Pool, Tiles},
};

const REASON: &str = "a score is off by d <= gamma_(D+2) sum|q k|, so its weight by a factor e^d times exp's allowance, 3 + 2|x| \
    units for |x| below the row's maximum and 3 more each time that the maximum rises; an output by the weights' sum \
    p_j |e^d_j - 1| |v_j - out|, never leaving the range of the values, or, where one key outweighs the others, by what \
    these may weigh beside it; plus gamma_n for the sum over the n values that are not 0, and for the sum of weights over \
    the additions of a lane, of which there are 4 at least. exp(0) is taken to be 1. \
    Pooled keys and values are off by gamma_n mean|x| and a division, and as 16 bits by their rounding; the logarithm of their count by \
    what Vulkan allows it";

/// Beyond 65,536 and 131,072.
const MANY: usize = 200_000;
const DOMINATING: [usize; 6] = [0, 65_535, 65_536, 131_071, 131_072, MANY - 1];

pub fn area() -> Area {
    let mut area = Area::new("ops/attention", "keys", Mode::FLOATS, REASON);
    let mut add = |name: &str, keys: usize, catches: Catches<Fault>, make: fn(usize) -> Problem| {
        area.add(name, keys, catches, move || make(keys));
    };
    let random = |keys| Problem::random(17, keys, 64, 1.0);
    add("random", 1, [NeighborHead].into(), random);
    let few = || Catches::from([NoScale, NoTotal, HalfOfKeys, NeighborHead, NeighborValue, LastKey, HalfSum]);
    for keys in [2, 31, 32, 33, 127, 129] {
        let padded: &[Fault] = if keys % 4 == 0 { &[] } else { &[Padding] };
        // Rounding errors of many keys average out.
        let rounded: &[Fault] = if keys > 100 { &[HalfWeights] } else { &[HalfWeights, HalfScores] };
        add("random", keys, few().and(padded).and(rounded), random);
    }
    add("random", 1300, few(), random);
    let slices = || Catches::from([NoTotal, HalfOfKeys, NeighborHead, HalfSum]);
    add("a slice of the keys in each channel", 1300, slices().and(&[KeysFrom(1280)]), |keys| sliced(17, keys));
    add("a slice of the keys in each channel", 62_401, slices().and(&[KeysFrom(62_000)]), |keys| sliced(1, keys));
    let many = [KeysFrom(MANY / 2), KeysFrom(65_536), KeysFrom(131_072), KeysFrom(MANY - 1000)];
    add("a slice of the keys in each channel", MANY, slices().and(&many), |keys| sliced(1, keys));
    // Workgroups of several synchronized subgroups.
    add("many queries", 129, [NeighborHead, NeighborValue, LastKey].into(), |keys| Problem::random(600, keys, 64, 1.0));
    let sizes = || Catches::from([NoScale, NoTotal, NeighborHead, NeighborValue]);
    add("heads of 8 channels", 70, sizes(), |keys| Problem::random(9, keys, 8, 1.0));
    add("heads of 48 channels", 70, sizes(), |keys| Problem::random(9, keys, 48, 1.0));
    add("heads of 128 channels", 70, sizes(), |keys| Problem::random(9, keys, 128, 1.0));
    let peaks = || Catches::from([NoMaximum, NeighborValue, NeighborHead]);
    add("logits of +-1e4", 325, peaks(), |keys| Problem::random(9, keys, 64, 120.0));
    add("activations of 1e4 before any norm", 325, peaks(), |keys| Problem::random(9, keys, 64, 1e4));
    add("all logits equal", 325, [NoTotal, HalfOfKeys, LastKey, HalfSum].into(), |keys| Problem {
        q: vec![0.0; 9 * 128],
        ..Problem::random(9, keys, 64, 1.0)
    });
    add("identical keys and values", 1300, [NoTotal, HalfSum, NeighborHead].into(), identical);
    let first = |key| Catches::from([Key(key), NoMaximum, NeighborValue]);
    add("key 0 dominates", 33, first(0), |keys| dominated(keys, 64, &[0]));
    add("key 32 dominates", 33, first(32), |keys| dominated(keys, 64, &[32]));
    add("key 800 dominates", 1300, [Key(800), NoMaximum].into(), |keys| dominated(keys, 64, &[800]));
    let lost = DOMINATING.map(Key);
    let catches = Catches::from([KeysFrom(65_536), KeysFrom(131_072), NoMaximum]).and(&lost);
    add("keys near 65,536, 131,072 and the last dominate", MANY, catches, |keys| dominated(keys, 16, &DOMINATING));
    add("maximum rises with every key", 500, [SumsNotScaled, TotalNotScaled, KeysFrom(499)].into(), rising);
    add("all logits far below zero", 70, [NoMaximum, NeighborHead].into(), |keys| {
        let mut problem = Problem::random(5, keys, 64, 1.0);
        problem.q.fill(30.0);
        problem.k.iter_mut().for_each(|k| *k -= 40.0);
        problem
    });
    let counts = || Catches::from([NoCounts, NeighborCount, NeighborHead, NeighborValue, LastKey, NoTotal]);
    add("means of 2 x 2 patches", 3 * (1 + 3 * 4), counts(), |_| pooled(GROUPS));
    add("means of 4 x 4 patches", 3 * (2 + 2 * 3), counts(), |_| pooled(pool(4, [7, 9], 2)));
    add("means, the own view whole", seen(OWN).keys(), counts(), |_| seen(OWN));
    add("means, the first view whole", seen(FIRST).keys(), counts(), |_| seen(FIRST));
    add("means, both whole", seen(BOTH).keys(), counts(), |_| seen(BOTH));
    let values = || Catches::from([NoTotal, HalfOfKeys, NeighborValue]);
    add("values near the largest f16", 325, values(), |keys| values_of(keys, 65_000.0));
    add("values of 1e30", 325, values(), |keys| values_of(keys, 1e30));
    add("every second value subnormal", 325, values(), |keys| {
        let mut problem = Problem::random(9, keys, 64, 1.0);
        problem.v.iter_mut().step_by(2).for_each(|v| *v *= 1e-39);
        problem
    });
    area
}

/// Rounding of random sums, with and without addresses.
fn variants(problem: Problem) -> [Problem; 2] {
    let without_addresses: fn(&mut Limits) = |limits| limits.addresses = false;
    let problem = Problem { is_tame: true, ..problem };
    [Problem { limits: without_addresses, ..problem.clone() }, problem]
}

/// Whole numbers, whose products add exactly.
fn whole(mut problem: Problem, [q, k]: [fn(f32) -> f32; 2]) -> Problem {
    problem.q.iter_mut().for_each(|x| *x = q(*x).round());
    problem.k.iter_mut().for_each(|x| *x = k(*x).round());
    problem
}

pub fn shapes() -> Area {
    let mut area = Area { cases: Vec::new(), ..area() };
    for dim in [4, 8, 16, 24, 32, 48, 64, 128] {
        let keys = [1, 2, 3, 4, 5, 31, 32, 33, 325, 1300];
        let make = move || keys.iter().flat_map(|&keys| variants(Problem::random(9, keys, dim, 1.0))).collect();
        area.sweep(format!("heads of {dim} channels"), 1300, [NeighborHead], make);
    }
    for shape in [[1, 1], [2, 3], [5, 2]] {
        let queries = [0, 1, 7, 8, 9, 15, 16, 17, 31, 33, 65, 130];
        let make =
            move || queries.iter().flat_map(|&queries| variants(Problem::of(shape, queries, 37, 16, 1.0))).collect();
        let name = format!("{} sequences of {} heads", shape[0], shape[1]);
        area.sweep(name, 37, [NeighborValue, HalfOfKeys], make);
    }
    for (side, grid, leading, dim) in [(2, [3, 5], 1, 64), (3, [4, 4], 0, 16), (4, [9, 7], 1, 16)] {
        let pool = pool(side, grid, leading);
        let make =
            move || variants(Problem { pool: Some(pool), ..Problem::random(9, 3 * pool.tokens(), dim, 1.0) }).into();
        area.sweep(format!("means of {side} x {side} patches"), 3 * pool.keys(), [NoCounts], make);
    }
    let queries = (ATTENTION_ROWS * GROUP_FOLD) as usize + 3;
    let many = move || variants(Problem::of([1, 1], queries, 2, 4, 1.0)).into();
    area.sweep("queries beyond a fold of workgroups", 2, [NeighborValue], many);
    for dim in [16, 64] {
        let shape: [fn(f32) -> f32; 2] = match dim {
            16 => [|q| 64.0 * q, |k| 1024.0 * k],
            _ => [|q| 64.0 * q, |k| 256.0 * k],
        };
        let make = move || variants(whole(Problem::of([2, 2], 11, 70, dim, 1.0), shape)).into();
        area.sweep(format!("exact logits of 1e4, {dim} channels"), 70, [NeighborValue], make);
    }
    let below = || variants(whole(Problem::of([1, 1], 5, 33, 16, 1.0), [|_| 64.0, |k| 8.0 * k - 48.0])).into();
    area.sweep("exact logits far below zero", 33, [NoMaximum], below);
    let equal = || {
        let problem = |keys| Problem { q: vec![0.0; 5 * 32], ..Problem::of([1, 1], 5, keys, 32, 1.0) };
        [3, 33, 325].into_iter().flat_map(|keys| variants(problem(keys))).collect()
    };
    area.sweep("equal logits", 325, [NoTotal], equal);
    let stored = || {
        let limits: fn(&mut Limits) = |limits| limits.matrices.conversions = false;
        let of = |dim, keys| Problem { limits, is_tame: true, ..Problem::of([2, 2], 19, keys, dim, 1.0) };
        let one = Problem { limits, is_tame: true, ..Problem::random(19, GROUPS.tokens(), 64, 1.0) };
        let logits = whole(of(64, 70), [|q| 64.0 * q, |k| 256.0 * k]);
        let pooled = Problem { pool: Some(GROUPS), ..one };
        [of(24, 33), of(64, 1), of(64, 325), of(128, 70), logits, pooled].into()
    };
    area.sweep("weights through shared memory", 325, [NeighborHead], stored);
    let tiles = || {
        let plain: fn(&mut Limits) = |limits| limits.matrices.conversions = false;
        let converting: fn(&mut Limits) = |_| ();
        let of = |limits, [heads, queries, keys, dim]: [usize; 4]| Problem {
            limits,
            tiles: Tiles::always(2),
            is_tame: true,
            ..Problem::of([1, heads], queries, keys, dim, 1.0)
        };
        [
            of(converting, [1, 1, 70, 8]),
            of(plain, [1, 1, 3, 24]),
            of(plain, [2, 70, 70, 24]),
            of(plain, [30, 300, 33, 24]),
        ]
        .into()
    };
    area.sweep("the third tile", 70, [NeighborValue], tiles);
    area
}

/// Limits channel c to the c-th part of the keys, so that a missing part shows.
fn sliced(queries: usize, keys: usize) -> Problem {
    let mut problem = Problem::random(queries, keys, 64, 1.0);
    for (i, v) in problem.v.iter_mut().enumerate() {
        let (key, head, channel) = (i / 128, i / 64 % 2, i % 64);
        // Distinguishes heads, and even from odd keys.
        let size = [1.5, 0.5][key % 2] * (1.0 + 0.1 * *v) * [1.0, -2.0][head];
        *v = if key * 64 / keys == channel { size } else { 0.0 };
    }
    problem
}

fn pool(side: usize, grid: [usize; 2], leading: usize) -> Pool {
    Pool { side, grid, leading, ..GROUPS }
}

const GROUPS: Pool = Pool { side: 2, grid: [5, 7], leading: 1, own: false, first: false };
const OWN: Pool = Pool { own: true, ..GROUPS };
const FIRST: Pool = Pool { first: true, ..GROUPS };
const BOTH: Pool = Pool { own: true, ..FIRST };

/// Three views, all of whose tokens are queries.
fn seen(pool: Pool) -> Problem {
    Problem { pool: Some(pool), ..Problem::random(3 * pool.tokens(), 3 * pool.tokens(), 64, 1.0) }
}

/// The views' last groups have fewer patches.
fn pooled(pool: Pool) -> Problem {
    Problem { pool: Some(pool), ..Problem::random(17, 3 * pool.tokens(), 64, 1.0) }
}

fn identical(keys: usize) -> Problem {
    let mut problem = Problem::random(5, keys, 64, 1.0);
    for values in [&mut problem.k, &mut problem.v] {
        let first = values[..128].to_vec();
        values.chunks_mut(128).for_each(|row| row.copy_from_slice(&first));
    }
    problem
}

/// The i-th dominating key is aligned with the i-th query.
fn dominated(keys: usize, dim: usize, dominating: &[usize]) -> Problem {
    let mut problem = Problem::random(dominating.len(), keys, dim, 4.0);
    let width = problem.width();
    for (query, key) in problem.q.chunks(width).zip(dominating) {
        let towards = problem.k[key * width..][..width].iter_mut().zip(query);
        towards.for_each(|(k, q)| *k = 40.0 * q.signum());
    }
    problem
}

/// Increasing scores force rescaling.
fn rising(keys: usize) -> Problem {
    let mut problem = Problem::random(5, keys, 64, 1.0);
    problem.q.fill(1.0);
    for (key, row) in problem.k.chunks_mut(128).enumerate() {
        row.iter_mut().for_each(|k| *k = 0.02 * key as f32 + 0.01 * *k);
    }
    problem
}

fn values_of(keys: usize, size: f32) -> Problem {
    let mut problem = Problem::random(9, keys, 64, 1.0);
    problem.v.iter_mut().for_each(|v| *v *= size);
    problem
}
