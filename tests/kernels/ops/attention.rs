//! Attention against f64 softmax over all scores.

use crate::case::{Case, attention_kernels, random, stored, with_and_without_addresses};
use zipsplat::gpu::{Element, Limits};
use zipsplat::kernels::limits::{ATTENTION_ROWS, GROUP_FOLD};
use zipsplat::ops::{Attention, AttentionKernel, Heads, Part, Pool, Rows};
use zipsplat_tests::compare::{Tolerance, assert_close};
use zipsplat_tests::device::device;
use zipsplat_tests::reference::ops::{attention::attention_to_means, split_heads};
use zipsplat_tests::reference::widen;

/// Unpooled queries, keys and values `[sequences * tokens, heads * dim]`.
struct Problem {
    shape: Attention,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
}

impl Problem {
    fn random(sequences: usize, queries: usize, keys: usize, count: usize, dim: usize) -> Problem {
        let width = count * dim;
        Problem {
            shape: Attention {
                heads: Heads { count, dim },
                sequences,
                queries,
                keys,
                pool: None,
                kernel: AttentionKernel::Lanes(Element::F32),
            },
            q: random(1, sequences * queries * width),
            k: random(2, sequences * keys * width),
            v: random(3, sequences * keys * width),
        }
    }

    /// Returns an attention of few queries to the pooled patches of `views`.
    fn pooled(views: usize, pool: Pool, count: usize, dim: usize) -> Problem {
        let problem = Problem::random(1, 9, views * pool.tokens(), count, dim);
        let shape = Attention { keys: views * pool.keys(), pool: Some(pool), ..problem.shape };
        Problem { shape, ..problem }
    }

    /// Checks every kernel.
    fn check(&self, name: &str) {
        for kernel in attention_kernels() {
            let name = format!("{name} {:?} {kernel:?}", self.shape);
            let tolerance = tolerance(self.shape, kernel.element());
            for limits in with_and_without_addresses(device().limits(), kernel == AttentionKernel::Lanes(Element::F32))
            {
                let got = self.attended(&limits, kernel);
                assert_close(&name, &got, &self.truth(kernel.element()), tolerance);
            }
        }
    }

    /// Runs the kernel with NaN in all padding, which must not spread.
    fn attended(&self, limits: &Limits, kernel: AttentionKernel) -> Vec<f32> {
        let shape = Attention { kernel, ..self.shape };
        let element = kernel.element();
        let mut case = Case::within(limits);
        let tensors = shape.tensors(&mut case.rec);
        let parts = [
            (&self.q, Part { scale: shape.scale(), ..Part::default() }),
            (&self.k, Part { keys: true, log_counts: Some(tensors[3]), ..Part::default() }),
            (&self.v, Part::default()),
        ];
        for (tensor, (values, part)) in tensors.into_iter().zip(parts) {
            // NaN as f32 and as two f16.
            case.rec.fill(tensor, u32::MAX);
            let (count, width) = (values.len() / shape.heads.width(), shape.heads.width());
            let projection = Rows { tensor: case.input_of(element, values), count, width, element };
            shape.split(&mut case.rec, projection, 0, part, tensor);
        }
        let out = shape.record(&mut case.rec, tensors).tensor;
        case.rec.output(out);
        case.result_of(element, out)
    }

    /// Computes the truth of inputs rounded to `element`.
    fn truth(&self, element: Element) -> Vec<f64> {
        let Attention { heads, queries, keys, .. } = self.shape;
        let [q, k, v] = [&self.q, &self.k, &self.v].map(|x| widen(&stored(element, x.clone())));
        let (k, counts) = self.means(element, k);
        let (v, _) = self.means(element, v);
        let kv = k.chunks(keys * heads.width()).zip(v.chunks(keys * heads.width())).zip(counts.chunks(keys));
        let sequences = q.chunks(queries * heads.width()).zip(kv);
        let attended = |(q, ((k, v), counts))| attention_to_means(q, [k, v], counts, heads.count, heads.dim);
        sequences.flat_map(attended).collect()
    }

    /// Returns the groups' mean keys or values rounded to `element`, and the group sizes.
    fn means(&self, element: Element, x: Vec<f64>) -> (Vec<f64>, Vec<f64>) {
        let width = self.shape.heads.width();
        let Some(Pool { side, grid, leading }) = self.shape.pool else {
            let counts = vec![1.0; x.len() / width];
            return (x, counts);
        };
        let (means, counts) = split_heads::Pool { side, grid, leading }.means(&x, width);
        (widen(&stored(element, means.iter().map(|mean| *mean as f32).collect())), counts)
    }
}

/// A score sums `dim` products; weights and results sum over keys. Averaging shrinks values and
/// errors alike.
fn tolerance(shape: Attention, element: Element) -> Tolerance {
    let sums = Tolerance::sum_of(shape.heads.dim).and(Tolerance::sum_of(shape.keys)).and(Tolerance::ELEMENTWISE);
    match element {
        Element::F32 => sums,
        // Rounded queries move scores, which are below 1 here, by less than themselves. Weights and
        // results are rounded, too.
        half => sums.and(Tolerance::sum_of_rounded(half, shape.keys)).stored_in(half),
    }
}

const DIMS: [usize; 9] = [4, 8, 16, 24, 32, 48, 64, 96, 128];

#[test]
fn every_head_size_and_number_of_keys() {
    for dim in DIMS {
        for keys in [1, 2, 3, 4, 5, 31, 32, 33, 325, 1300] {
            Problem::random(1, 9, keys, 2, dim).check("random");
        }
    }
}

#[test]
fn every_number_of_queries_and_sequences() {
    for queries in [1, 7, 8, 9, 15, 16, 17, 31, 33, 65, 130] {
        for (sequences, heads) in [(1, 1), (2, 3), (5, 2)] {
            Problem::random(sequences, queries, 37, heads, 16).check("random");
        }
    }
    let none = Problem::random(1, 0, 5, 2, 16);
    assert!(attention_kernels().into_iter().all(|kernel| none.attended(device().limits(), kernel).is_empty()));
}

#[test]
fn keys_that_stand_for_several() {
    for (side, grid, leading, dim) in [(2, [3, 5], 1, 64), (3, [4, 4], 0, 16), (4, [9, 7], 1, 16)] {
        Problem::pooled(3, Pool { side, grid, leading }, 2, dim).check("pooled");
    }
}

#[test]
fn one_head_over_very_many_queries() {
    // More workgroups along x than the fold of a one-dimensional dispatch.
    Problem::random(1, ATTENTION_ROWS as usize * GROUP_FOLD as usize + 3, 2, 1, 4).check("many queries");
}

#[test]
fn logits_of_ten_thousand() {
    // Integer products add exactly in f32, so only the softmax is compared.
    for dim in [16, 64] {
        let mut problem = Problem::random(2, 11, 70, 2, dim);
        let whole = |x: &mut f32, most: f32| *x = (*x * most).round();
        problem.q.iter_mut().for_each(|x| whole(x, 64.0));
        problem.k.iter_mut().for_each(|x| whole(x, 16384.0 / dim as f32));
        let width = problem.shape.heads.width();
        let score = |q: &[f32], k: &[f32]| q.iter().zip(k).map(|(a, b)| a * b).sum::<f32>() / (dim as f32).sqrt();
        let keys = || problem.k[..70 * width].chunks(width);
        let largest = keys().map(|k| score(&problem.q[..dim], &k[..dim])).fold(0.0f32, |a, s| a.max(s.abs()));
        assert!(largest > 1e4, "{largest}");
        problem.check("large logits");
    }
}

#[test]
fn equal_keys_weigh_the_same() {
    for keys in [3, 33, 325] {
        let mut problem = Problem::random(1, 5, keys, 1, 32);
        let first = problem.k[..32].to_vec();
        problem.k.chunks_mut(32).for_each(|key| key.copy_from_slice(&first));
        problem.check("equal keys");
    }
}

#[test]
fn one_key_takes_all() {
    for (keys, chosen) in [(33, 0), (33, 32), (325, 170)] {
        let mut problem = Problem::random(1, 5, keys, 1, 16);
        problem.q.fill(8.0);
        problem.k[16 * chosen..16 * (chosen + 1)].fill(50.0);
        let value = problem.v[16 * chosen..16 * (chosen + 1)].repeat(5);
        assert_close("truth", &problem.truth(Element::F32), &value, Tolerance::STORED);
        problem.check("dominating key");
    }
}

#[test]
fn all_logits_far_below_zero() {
    let mut problem = Problem::random(1, 5, 33, 1, 16);
    problem.q.fill(64.0);
    problem.k.iter_mut().for_each(|x| *x = (*x * 8.0).round() - 48.0);
    problem.check("negative logits");
}

#[test]
fn tiles_of_gpus() {
    // CPUs get smaller tiles, which compile faster.
    let limits = Limits { cpu: false, ..device().limits().clone() };
    for (queries, keys, heads, dim) in [(1, 3, 1, 64), (70, 70, 2, 64), (300, 33, 30, 24)] {
        let problem = Problem::random(1, queries, keys, heads, dim);
        for kernel in attention_kernels() {
            let tolerance = tolerance(problem.shape, kernel.element());
            let name = format!("{:?} {kernel:?}", problem.shape);
            assert_close(&name, &problem.attended(&limits, kernel), &problem.truth(kernel.element()), tolerance);
        }
    }
}
