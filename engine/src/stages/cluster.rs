//! Token selection by features.
//!
//! Source: ZipSplat, section 3.1, "Compression by clustering".

use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::cluster as kernels,
    ops::{
        Nearest, NearestKernel, Rows, gather_rows, place_groups,
        scan::exclusive_scan,
        sort::{key_bits, key_starts, sort_pairs},
    },
    random::Random,
};

/// Values of 4 bytes between aligned slices.
const SLICE: usize = 64;

/// The reference's k-means rounds.
pub const ROUNDS: usize = 5;

/// Clusters at `ratio` in (0, 1]: truncated, at least one.
pub fn cluster_count(tokens: usize, ratio: f64) -> usize {
    ((tokens as f64 * ratio) as usize).clamp(1, tokens.max(1))
}

/// The paper's ratio.
pub fn auto_ratio(views: usize) -> f64 {
    (0.5 * (2.0 / views.max(1) as f64).sqrt()).min(1.0)
}

/// Evenly spread indices, bit-equal to PyTorch's f32 `linspace`, rounded half to even.
pub fn even_indices(tokens: usize, count: usize) -> Vec<u32> {
    let last = (tokens - 1) as f32;
    let step = last / (count - 1).max(1) as f32;
    (0..count)
        .map(|i| {
            if count == 1 {
                0.0
            } else if i < count / 2 {
                step * i as f32
            } else {
                (-step).mul_add((count - 1 - i) as f32, last)
            }
        })
        .map(|x| x.round_ties_even() as u32)
        .collect()
}

/// Distinct indices below `tokens`, ascending, reproducible by seed.
pub fn random_indices(tokens: usize, count: usize, seed: u64) -> Vec<u32> {
    // Selection sampling (Knuth, TAOCP 2, 3.4.2, algorithm S).
    let mut random = Random::new(seed);
    let mut chosen = Vec::with_capacity(count);
    for token in 0..tokens {
        if random.below(tokens - token) < count - chosen.len() {
            chosen.push(token as u32);
        }
    }
    chosen
}

/// Records k-means from the tokens `initial` `[clusters]`. Returns each centroid's nearest token,
/// `[clusters]` u32.
pub fn record(
    rec: &mut Recorder,
    kernel: NearestKernel,
    tokens: Rows,
    initial: Tensor,
    clusters: usize,
    rounds: usize,
) -> Tensor {
    let nearest = Nearest::among(rec, kernel, tokens);
    let token_rows = nearest.rows(rec, tokens);
    let centroids = gather_rows(rec, tokens, initial, clusters);
    let means = Means::new(rec, tokens.count);
    for round in 0..rounds {
        let centroid_rows = nearest.rows(rec, centroids);
        let cluster_of_point = nearest.record(rec, token_rows, centroid_rows);
        means.record(rec, tokens, cluster_of_point, centroids);
        if round + 1 == rounds {
            rec.observe("assign", cluster_of_point);
        }
    }
    rec.observe("centroids", centroids.tensor);
    let centroid_rows = nearest.rows(rec, centroids);
    let chosen = nearest.record(rec, centroid_rows, token_rows);
    rec.observe("nearest", chosen);
    chosen
}

/// Records the selection of `count` tokens of `views` by mutual nearest neighbors, `[count]` u32.
///
/// Of the tokens that show a point, the first view's remains. Matching, unlike order, as in the
/// paper's appendix D.
pub fn mutual(rec: &mut Recorder, kernel: NearestKernel, tokens: Rows, views: usize, count: usize) -> Tensor {
    let Rows { count: all, width, .. } = tokens;
    let (patches, pitch) = (all / views, all.next_multiple_of(SLICE));
    let nearest = Nearest::among(rec, kernel, tokens);
    let token_rows = nearest.rows(rec, tokens);
    let lists = rec.tensor::<u32>("nearest_by_view", views * pitch);
    for view in 0..views {
        // Rows of a view may start off a slice's alignment.
        let of_view = Rows::scratch(rec, "view", patches, width, Element::F32);
        place_groups(rec, tokens, [view * patches, patches, all], of_view, 0);
        let of_view = nearest.rows(rec, of_view);
        nearest.record_into(rec, token_rows, of_view, lists.slice::<u32>(view * pitch, all));
    }
    let (keys, bits) = (rec.tensor::<u32>("keys", all), key_bits(all).max(1));
    let [views, patches, pitch] = [views, patches, pitch].map(|size| size as u32);
    rec.dispatch(kernels::Mutual { nearest: lists, keys, views, patches, pitch, bits }, all);
    let (indices, index_count) = enumerate(rec, all);
    let (_, order) = sort_pairs(rec, keys, indices, index_count, all, bits + key_bits(views as usize));
    let chosen = rec.tensor::<u32>("chosen", count);
    rec.copy(order.slice::<u32>(0, count), chosen);
    rec.observe("nearest", chosen);
    chosen
}

/// Returns the indices below `count`, `[count]` u32, and their number, `[1]` u32.
fn enumerate(rec: &mut Recorder, count: usize) -> (Tensor, Tensor) {
    let indices = rec.tensor::<u32>("points", count);
    rec.fill(indices, 1);
    exclusive_scan(rec, indices, count);
    let index_count = rec.tensor::<u32>("point_count", 1);
    rec.fill(index_count, count as u32);
    (indices, index_count)
}

#[derive(Clone, Copy, Debug)]
pub struct Means {
    points: Tensor,
    point_count: Tensor,
}

impl Means {
    pub fn new(rec: &mut Recorder, count: usize) -> Self {
        let (points, point_count) = enumerate(rec, count);
        Self { points, point_count }
    }

    /// Writes cluster means, added in order, zero if empty. Rows are f32 with a width divisible by
    /// 4.
    pub fn record(&self, rec: &mut Recorder, points: Rows, cluster_of_point: Tensor, centroids: Rows) {
        let Rows { count: clusters, width, .. } = centroids;
        let (sorted, members) =
            sort_pairs(rec, cluster_of_point, self.points, self.point_count, points.count, key_bits(clusters));
        let starts = key_starts(rec, sorted, self.point_count, clusters);
        let kernel = kernels::Mean {
            points: points.tensor,
            members,
            starts,
            centroids: centroids.tensor,
            cluster_count: clusters as u32,
            width: width as u32,
        };
        rec.dispatch(kernel, clusters * width / 4);
    }
}
