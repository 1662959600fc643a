//! Random weights against f64, real ones, if present, against goldens.

use std::collections::HashMap;
use zipsplat::ops::ParameterLayout;
use zipsplat::stages::lpips::{Lpips, LpipsNetwork, LpipsPictures};
use zipsplat::{perceptual::Perceptual, weights::Values};
use zipsplat_tests::golden::{interleaved, lpips_weights};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::lpips::{Layer, lpips};

const NETWORKS: [LpipsNetwork; 2] = [LpipsNetwork::Vgg, LpipsNetwork::Alex];

/// Outputs, side, step, padding, pooling before it, and whether features are compared.
type Row = (usize, usize, usize, usize, Option<[usize; 2]>, bool);

fn rows(network: LpipsNetwork) -> Vec<Row> {
    let vgg = |outputs, pooled: bool, tap| (outputs, 3, 1, 1, pooled.then_some([2, 2]), tap);
    match network {
        LpipsNetwork::Vgg => vec![
            vgg(64, false, false),
            vgg(64, false, true),
            vgg(128, true, false),
            vgg(128, false, true),
            vgg(256, true, false),
            vgg(256, false, false),
            vgg(256, false, true),
            vgg(512, true, false),
            vgg(512, false, false),
            vgg(512, false, true),
            vgg(512, true, false),
            vgg(512, false, false),
            vgg(512, false, true),
        ],
        LpipsNetwork::Alex => vec![
            (64, 11, 4, 2, None, true),
            (192, 5, 1, 2, Some([3, 2]), true),
            (384, 3, 1, 1, Some([3, 2]), true),
            (256, 3, 1, 1, None, true),
            (256, 3, 1, 1, None, true),
        ],
    }
}

/// Random weights that keep the features' size.
fn weights(network: LpipsNetwork) -> HashMap<String, Vec<f32>> {
    let (mut inputs, mut taps, mut found) = (3, 0, HashMap::new());
    for (i, (outputs, side, _, _, _, tap)) in rows(network).into_iter().enumerate() {
        let inner = side * side * inputs;
        let most = (6.0 / inner as f32).sqrt();
        let weight = random(2 * i as u64 + 1, outputs * inner).iter().map(|x| most * x).collect();
        found.insert(format!("convolutions.{i}.weight"), weight);
        found
            .insert(format!("convolutions.{i}.bias"), random(99 + i as u64, outputs).iter().map(|x| 0.1 * x).collect());
        if tap {
            found.insert(format!("taps.{taps}.weight"), random(77, outputs).iter().map(|x| x.abs()).collect());
            taps += 1;
        }
        inputs = outputs;
    }
    found
}

struct Pair {
    a: Vec<f32>,
    b: Vec<f32>,
    size: [usize; 2],
}

struct LpipsResult {
    value: f32,
    layers: Vec<f32>,
    d_a: Vec<f32>,
}

impl Pair {
    fn random([width, height]: [usize; 2]) -> Self {
        let picture = |seed| random(seed, 3 * width * height).iter().map(|x| 0.5 + 0.55 * x).collect();
        Self { a: picture(5), b: picture(6), size: [width, height] }
    }

    fn golden(golden: &Golden, case: &str) -> Self {
        let shape = golden.shape(&format!("{case}/a"));
        let picture = |key: &str| interleaved(&golden.f32(&format!("{case}/{key}")), shape[1] * shape[2]);
        Self { a: picture("a"), b: picture("b"), size: [shape[2], shape[1]] }
    }

    fn compared(
        &self,
        limits: &Limits,
        network: LpipsNetwork,
        read: impl Fn(&str, &mut [f32]),
        clipped: bool,
        weight: Option<f32>,
    ) -> LpipsResult {
        let mut parameters = ParameterLayout::new(device().limits(), Arithmetic::EXACT);
        let stage = Lpips::new(&mut parameters, network, true);
        let read = |name: &str, out: &mut [f32]| {
            read(name, out);
            Ok(())
        };
        let loaded = parameters.load(device(), &read, |_| ControlFlow::Continue(())).unwrap();
        let mut rec = Recorder::new(limits);
        let [a, b, d_a] = ["a", "b", "d_a"].map(|name| rec.input::<f32>(name, self.a.len()));
        let [width, height] = self.size;
        let of = LpipsPictures { pictures: [(a, 3), (b, 3)], size: [height, width], clipped };
        let found = stage.record(&mut rec, of, weight.map(|weight| (weight, d_a)));
        [found.value, found.layers, d_a].into_iter().for_each(|tensor| rec.output(tensor));
        let mut run = Run::with_resident(device(), rec.finish().unwrap(), [loaded.resident]).unwrap();
        run.write(a, &self.a).unwrap();
        run.write(b, &self.b).unwrap();
        run.write(d_a, &vec![if weight.is_some() { 0.0f32 } else { 1.0 }; self.a.len()]).unwrap();
        run.execute().unwrap();
        let value = run.read::<f32>(found.value).unwrap()[0];
        LpipsResult { value, layers: run.read(found.layers).unwrap(), d_a: run.read(d_a).unwrap() }
    }
}

fn reference(network: LpipsNetwork, weights: &HashMap<String, Vec<f32>>) -> Vec<Layer> {
    let mut taps = 0..;
    let layer = |(i, (_, side, step, padding, pool, tap)): (usize, Row)| Layer {
        weight: weights[&format!("convolutions.{i}.weight")].clone(),
        bias: weights[&format!("convolutions.{i}.bias")].clone(),
        side,
        step,
        padding,
        pool,
        tap: tap.then(|| weights[&format!("taps.{}.weight", taps.next().unwrap())].clone()),
    };
    rows(network).into_iter().enumerate().map(layer).collect()
}

#[test]
fn equals_the_reference() {
    for (network, size) in [(NETWORKS[0], [17, 16]), (NETWORKS[1], [33, 39])] {
        let (weights, pair) = (weights(network), Pair::random(size));
        let layers = reference(network, &weights);
        let (a, b) = (widen(&pair.a), widen(&pair.b));
        for clipped in [false, true] {
            let read = |name: &str, out: &mut [f32]| out.copy_from_slice(&weights[name]);
            let found = pair.compared(device().limits(), network, read, clipped, Some(0.5));
            let truth = lpips(&layers, [&a, &b], size[0], clipped);
            let name = format!("{network:?} of {size:?}");
            assert_close(&name, &found.layers, &truth, Tolerance { max: 1e-5, rms: 1e-5 });
            assert!((f64::from(found.value) - truth.iter().sum::<f64>()).abs() < 1e-5 * truth.iter().sum::<f64>());
            let plain = pair.compared(device().limits(), network, read, clipped, None);
            assert_same(&format!("{name} without gradient"), &plain.layers, &found.layers);
            assert!(plain.d_a.iter().all(|x| *x == 1.0));

            // Rectifiers and pools rarely switch.
            let direction = widen(&random(8, a.len()));
            let moved = |step: f64| {
                let moved: Vec<f64> = a.iter().zip(&direction).map(|(a, d)| a + step * d).collect();
                lpips(&layers, [&moved, &b], size[0], clipped).iter().sum::<f64>()
            };
            let slope = 0.5 * (moved(1e-7) - moved(-1e-7)) / 2e-7;
            let along: f64 = found.d_a.iter().zip(&direction).map(|(g, d)| f64::from(*g) * d).sum();
            let size: f64 = found.d_a.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            assert!((along - slope).abs() < 2e-5 * size, "{name}: {along}, slope {slope}, gradient {size}");
        }
    }
}

#[test]
fn equals_the_goldens() {
    let Some(golden) = Golden::open("lpips.safetensors") else { return };
    for network in NETWORKS {
        let Some(path) = lpips_weights(network) else { continue };
        let mut layout = ParameterLayout::new(device().limits(), Arithmetic::EXACT);
        Lpips::new(&mut layout, network, false);
        let tensors = Values::open(&path, "LPIPS", layout.names_and_shapes()).unwrap();
        let mut metric = Perceptual::open(device(), network, &path, false).unwrap();
        for case in golden.stems(&format!("/{}/loss", network.name())) {
            let pair = Pair::golden(&golden, &case);
            let key = |what: &str| golden.f64(&format!("{case}/{}/{what}", network.name()));
            let found = pair.compared(
                device().limits(),
                network,
                |name, out| tensors.read_f32(name, out).unwrap(),
                true,
                Some(1.0),
            );
            let name = format!("{case} {network:?}");
            assert_close(&name, &[found.value], &key("loss"), Tolerance::rms(1e-5));
            assert_close(&format!("{name} layers"), &found.layers, &key("layers"), Tolerance::rms(1e-5));
            let distance = metric.distance([&pair.a, &pair.b], pair.size.map(|side| side as u32)).unwrap();
            let off = assert_close(&format!("{name} metric"), &[distance], &key("metric"), Tolerance::rms(1e-5));
            println!("{name}: {distance:.4}, off by {:.1e}", off.rms);
            assert_close(
                &format!("{name} d_a"),
                &found.d_a,
                &interleaved(&key("d_a"), pair.a.len() / 3),
                Tolerance::rms(1e-4),
            );
        }
    }
}

#[test]
fn equal_pictures_are_at_no_distance() {
    for network in NETWORKS {
        let weights = weights(network);
        let read = |name: &str, out: &mut [f32]| out.copy_from_slice(&weights[name]);
        let mut pair = Pair::random([34, 31]);
        pair.b = pair.a.clone();
        let found = pair.compared(device().limits(), network, read, false, Some(1.0));
        assert_eq!(found.value, 0.0);
        assert!(found.d_a.iter().all(|x| *x == 0.0));
    }
}

#[test]
fn parts_give_the_same_bits() {
    // The first layer's features take 4.3 MB, a weight 3.5.
    let narrow = Limits { max_binding_bytes: 4 << 20, ..device().limits().clone() };
    let (network, pair) = (LpipsNetwork::Alex, Pair::random([520, 524]));
    let weights = weights(network);
    let read = |name: &str, out: &mut [f32]| out.copy_from_slice(&weights[name]);
    let [got, truth] = [&narrow, device().limits()].map(|limits| pair.compared(limits, network, read, true, Some(1.0)));
    assert_same("layers", &got.layers, &truth.layers);
    assert_same("gradient", &got.d_a, &truth.d_a);
}
