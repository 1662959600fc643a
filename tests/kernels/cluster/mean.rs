use crate::case::*;
use zipsplat::{ops::NearestKernel, stages::cluster, stages::cluster::Means};
use zipsplat_tests::reference::cluster::mean::mean;

fn centroids(points: &[f32], cluster_of_point: &[u32], clusters: usize, width: usize) -> Vec<f32> {
    let mut case = plan();
    let out = case.output::<f32>(clusters * width);
    let (count, assigned) = (cluster_of_point.len(), case.input(cluster_of_point));
    let points = Rows::new(case.input(points), count, width);
    let means = Means::new(&mut case.rec, count);
    means.record(&mut case.rec, points, assigned, Rows::new(out, clusters, width));
    case.result(out).unwrap()
}

fn check(count: usize, clusters: usize, width: usize) {
    // No mean is small by chance.
    let points: Vec<f32> = random(1, count * width).iter().map(|x| x + 1.5).collect();
    let assigned = random_below(2, count, clusters as u32);
    let got = centroids(&points, &assigned, clusters, width);
    let truth = mean(&widen(&points), &assigned, clusters, width);
    assert_close(&format!("{count} points, {clusters} x {width}"), &got, &truth, Tolerance::sum_of(count));
}

#[test]
fn equals_the_reference() {
    // Around subgroups and a digit of the sort.
    for count in [1, 7, 8, 9, 31, 32, 33, 65, 500] {
        for width in [4, 64, 68, 132, 384] {
            for clusters in [1, 2, 9, 256, 257] {
                check(count, clusters, width);
            }
        }
    }
    check(20_000, 3, 8);
    check(40, 65_537, 4);
}

#[test]
fn a_cluster_without_points_is_zero() {
    let points = random(3, 5 * 12);
    let got = centroids(&points, &[1, 1, 4, 1, 4], 6, 12);
    for (cluster, centroid) in got.chunks(12).enumerate() {
        let empty = ![1, 4].contains(&cluster);
        assert_eq!(centroid.iter().all(|x| *x == 0.0), empty, "cluster {cluster}: {centroid:?}");
    }
    assert_same("no points", &centroids(&[], &[], 3, 4), &[0.0; 12]);
}

#[test]
fn a_cluster_of_one_is_its_point() {
    let points = random(4, 9 * 20);
    let order = [4, 2, 0, 8, 6, 1, 3, 5, 7u32];
    let got = centroids(&points, &order, 9, 20);
    for (point, &cluster) in points.chunks(20).zip(&order) {
        assert_same("centroid", &got[cluster as usize * 20..][..20], point);
    }
}

#[test]
fn clusters_as_the_goldens() {
    let golden = Golden::committed("kmeans.safetensors");
    let cases = golden.stems("/x");
    assert!(cases.len() >= 10);
    for kernel in nearest_kernels() {
        cases.iter().for_each(|name| check_golden(&golden, name, kernel));
    }
}

fn check_golden(golden: &Golden, name: &str, kernel: NearestKernel) {
    let key = |part: &str| format!("{name}/{part}");
    let (x, width, clusters) = (golden.f32(&key("x")), golden.shape(&key("x"))[1], golden.u32(&key("K"))[0] as usize);
    let Found { nearest, assigned, centroids } = clustered(&x, width, clusters, kernel);
    let what = |part: &str| format!("{} {kernel:?}", key(part));
    assert_same(&what("assign"), &assigned, &golden.u32(&key("assign_exact")));
    // One cluster may have all points.
    let tolerance = Tolerance::sum_of(x.len() / width);
    assert_close(&what("centroids"), &centroids, &golden.f32(&key("centroids_exact")), tolerance);
    // Rounding decides ties.
    let gaps = golden.f32(&key("nearest_gap"));
    let clear: Vec<usize> = (0..clusters).filter(|&k| gaps[k] > 1e-4).collect();
    let pick = |indices: &[u32]| clear.iter().map(|&k| indices[k]).collect::<Vec<_>>();
    assert_same(&what("nearest"), &pick(&nearest), &pick(&golden.u32(&key("nearest_exact"))));
    assert_as_near(&what("nearest"), &nearest, &centroids, &x, width);
}

struct Found {
    nearest: Vec<u32>,
    assigned: Vec<u32>,
    centroids: Vec<f32>,
}

fn clustered(x: &[f32], width: usize, clusters: usize, kernel: NearestKernel) -> Found {
    let count = x.len() / width;
    let mut case = plan();
    case.rec = case.rec.observing();
    let (tokens, initial) =
        (Rows::new(case.input(x), count, width), case.input(&cluster::even_indices(count, clusters)));
    let nearest = cluster::record(&mut case.rec, kernel, tokens, initial, clusters, cluster::ROUNDS);
    case.rec.output(nearest);
    let run = case.run().unwrap();
    let observed = |what: &str| run.observed().iter().find(|(name, _)| name == what).expect(what).1;
    Found {
        nearest: run.read(nearest).unwrap(),
        assigned: run.read(observed("assign")).unwrap(),
        centroids: run.read(observed("centroids")).unwrap(),
    }
}

/// Clusters of two lie midway between their members: rounding must not decide.
#[test]
fn rounding_chooses_no_token() {
    let (count, clusters, width) = (288, 144, 96);
    let x = random(5, count * width);
    let plain = clustered(&x, width, clusters, NearestKernel::Lanes);
    let members = |cluster| plain.assigned.iter().filter(|assigned| **assigned == cluster).count();
    assert!((0..clusters as u32).filter(|cluster| members(*cluster) == 2).count() > 20, "{:?}", plain.assigned);
    for kernel in nearest_kernels() {
        for round in 0..4 {
            let channel = |c: usize| (c * [1, 5, 7, 11][round] + round) % width;
            let moved = random(6 + round as u64, x.len());
            let moved: Vec<f32> = (0..x.len())
                .map(|i| x[i / width * width + channel(i % width)] * (1.0 + 1e-6 * round as f32 * moved[i]))
                .collect();
            assert_same(
                &format!("{kernel:?}, {round}"),
                &clustered(&moved, width, clusters, kernel).nearest,
                &plain.nearest,
            );
        }
    }
}

#[test]
fn first_centroids_are_spread_as_in_the_goldens() {
    let golden = Golden::committed("kmeans.safetensors");
    let keys: Vec<_> = golden.keys().into_iter().filter(|key| key.starts_with("linspace/")).collect();
    assert!(keys.len() >= 20);
    for key in keys {
        let (tokens, k) = key["linspace/".len()..].split_once('_').expect("tokens_k");
        assert_same(&key, &cluster::even_indices(tokens.parse().unwrap(), k.parse().unwrap()), &golden.u32(&key));
    }
    for row in golden.f64("k_of_compression@f64").chunks(3).filter(|row| row[1] <= 1.0) {
        assert_eq!(cluster::cluster_count(row[0] as usize, row[1]), row[2] as usize, "{row:?}");
    }
}
