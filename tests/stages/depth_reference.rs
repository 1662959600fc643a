use std::{collections::BTreeSet, ops::ControlFlow::Continue};
use zipsplat::depth::{DepthMap, DepthModel, DepthOptions, DepthPrediction};
use zipsplat::weights::{DepthArchitecture, DepthCheckpoint};
use zipsplat_tests::architectures::{depth_micro, depth_micro_alone};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::depth::{Sizes, View, features, views};
use zipsplat_tests::reference::{
    cluster::{
        kmeans::kmeans,
        mutual::{nearest_by_view, order},
    },
    model::Weights,
};

/// As for the heads' goldens.
const WITHIN: Tolerance = Tolerance { max: 1e-4, rms: 3e-5 };

pub(crate) fn pictures(count: u32, [width, height]: [u32; 2]) -> Vec<Image> {
    let byte = |i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8;
    let picture = |v: u32| (0..3 * width * height).map(|i| byte(i + (v << 18) + 1)).collect();
    (0..count).map(|v| Image::new(width, height, picture(v)).unwrap()).collect()
}

fn predict(a: &DepthArchitecture, pictures: &[Image], request: &DepthOptions) -> DepthPrediction {
    let checkpoint = DepthCheckpoint::seeded(a.clone(), "twin").unwrap();
    let model = DepthModel::from_checkpoint(device(), &checkpoint, Arithmetic::EXACT, |_| Continue(())).unwrap();
    model.predict(pictures, request, |_| Continue(())).unwrap()
}

fn weights(a: &DepthArchitecture) -> (Weights, Sizes) {
    let checkpoint = DepthCheckpoint::seeded(a.clone(), "twin").unwrap();
    let weights = network::weights(&checkpoint).unwrap();
    let b = &a.backbone;
    let out_layers = std::array::from_fn(|i| b.out_layers[i]);
    let sizes = Sizes {
        patch: b.patch_size,
        width: b.width,
        depth: b.depth,
        heads: b.heads,
        alt_start: b.alt_start,
        out_layers,
    };
    (weights, sizes)
}

fn both(a: &DepthArchitecture, pictures: &[Image], reference: usize) -> (Vec<DepthMap>, Vec<View>) {
    let request = DepthOptions { reference_view: Some(reference), ..DepthOptions::default() };
    let (weights, sizes) = weights(a);
    (predict(a, pictures, &request).views, views(&weights, &sizes, &network::images(pictures).normalized(), reference))
}

fn every(values: &[f64], first: usize, step: usize) -> Vec<f64> {
    values[first..].iter().step_by(step).copied().collect()
}

fn logarithms(values: &[f32]) -> Vec<f32> {
    values.iter().map(|value| value.ln()).collect()
}

#[test]
fn views_that_see_each_other() {
    let (found, truth) = both(&depth_micro(), &pictures(3, [42, 28]), 1);
    for (i, (found, truth)) in found.iter().zip(&truth).enumerate() {
        assert_close(&format!("depth of {i}"), &logarithms(&found.depth), &every(&truth.depth, 0, 2), WITHIN);
        let expected: Vec<f64> = every(&truth.depth, 1, 2).into_iter().map(|x| (1.0 + x.exp()).ln()).collect();
        let confidence = logarithms(found.confidence.as_ref().unwrap());
        assert_close(&format!("confidence of {i}"), &confidence, &expected, WITHIN);
        let (rays, of_truth) = (found.rays.as_ref().unwrap(), truth.rays.as_ref().unwrap());
        let values = |ray: usize| [rays.directions[ray], rays.origins[ray]].concat();
        let linear: Vec<f32> = (0..rays.directions.len()).flat_map(values).collect();
        let expected: Vec<f64> = of_truth.chunks(7).flat_map(|ray| ray[..6].to_vec()).collect();
        assert_close(&format!("rays of {i}"), &linear, &expected, WITHIN);
        assert_close(&format!("camera of {i}"), &found.encoding.unwrap(), truth.camera.as_ref().unwrap(), WITHIN);
    }
}

#[test]
fn chosen_patches() {
    let (a, pictures) = (depth_micro(), pictures(3, [42, 28]));
    let request = DepthOptions { reference_view: Some(0), ratio: Ratio::Fixed(0.5), ..DepthOptions::default() };
    let found = predict(&a, &pictures, &request).patches.unwrap();
    let (weights, sizes) = weights(&a);
    let (layers, _) = features(&weights, &sizes, &network::images(&pictures).normalized(), 0);
    let clusters = kmeans(&layers[3], 2 * sizes.width, 9);
    // Exact ties give the first; otherwise rounding must not decide.
    let clear = |gap: &f64| *gap > 1e-4 || *gap < 1e-9;
    assert!(clusters.gaps.iter().all(clear), "another key: {:?}", clusters.gaps);
    let expected: Vec<u32> = clusters.nearest.into_iter().collect::<BTreeSet<_>>().into_iter().collect();
    assert_eq!(found, expected);
    let mutual = DepthOptions { token_selection: TokenSelection::MutualNearest, ..request.clone() };
    let truth = order(&nearest_by_view(&layers[3], 2 * sizes.width, 6), 6);
    let expected: BTreeSet<u32> = truth[..9].iter().copied().collect();
    assert_eq!(predict(&a, &pictures, &mutual).patches.unwrap(), Vec::from_iter(expected));
    let given = DepthOptions { token_selection: TokenSelection::Given(vec![5, 17, 5]), ..request };
    assert_eq!(predict(&a, &pictures, &given).patches.unwrap(), [5, 17]);
}

#[test]
fn views_by_themselves() {
    let (found, truth) = both(&depth_micro_alone(), &pictures(2, [28, 42]), 0);
    for (i, (found, truth)) in found.iter().zip(&truth).enumerate() {
        assert_close(&format!("depth of {i}"), &logarithms(&found.depth), &truth.depth, WITHIN);
        let sky: Vec<f64> = truth.sky.as_ref().unwrap().iter().map(|x| x.max(0.0)).collect();
        assert_close(&format!("sky of {i}"), found.sky.as_ref().unwrap(), &sky, WITHIN);
        assert!(found.encoding.is_none() && truth.camera.is_none());
    }
}
