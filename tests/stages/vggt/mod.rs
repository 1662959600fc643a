//! VGGT against PyTorch, tap by tap: the f64 reference, then the device.

mod tokens;
mod weights;

use crate::depth::{Observed, architecture, compare, config, planar, tolerance};
use std::collections::BTreeMap;
use zipsplat::cameras::{camera_to_world, decoded_camera};
use zipsplat::stages::backbone::interpolate_antialiased;
use zipsplat::types::{Fitting, bounded_views};
use zipsplat::weights::{DepthArchitecture, DepthCheckpoint};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::backbone::{patchify::Images, positions};
use zipsplat_tests::reference::model::Scope;
use zipsplat_tests::reference::model::Taps;
use zipsplat_tests::reference::ops::split_heads::Keys;
use zipsplat_tests::reference::vggt::{self, Sizes};

fn goldens() -> impl Iterator<Item = Golden> {
    let others = ["vggt_units", "vggt_pre"];
    let of_network =
        move |file: &String| !file.contains(".weights.") && !others.iter().any(|name| file.starts_with(name));
    golden::list("vggt_").into_iter().filter(of_network).filter_map(|file| Golden::open(&file))
}

fn sizes(a: &DepthArchitecture) -> Sizes {
    let b = &a.backbone;
    let (embedding, pairs) = (b.alt_start, (b.depth - b.alt_start) / 2);
    Sizes { patch: b.patch_size, width: b.width, heads: b.heads, embedding, pairs }
}

fn out_pairs(a: &DepthArchitecture) -> impl Iterator<Item = usize> {
    a.backbone.out_layers.iter().map(|block| (block - a.backbone.alt_start) / 2)
}

/// `[tokens, width]` of both blocks to `[tokens, 2 width]`.
fn joined<T: Copy>([frame, global]: [&[T]; 2], width: usize) -> Vec<T> {
    frame.chunks(width).zip(global.chunks(width)).flat_map(|(a, b)| a.iter().chain(b)).copied().collect()
}

/// Point and confidence by the values of the point head.
fn world_point(values: &[f64]) -> ([f64; 3], f64) {
    ([0, 1, 2].map(|i| values[i].abs().exp_m1().copysign(values[i])), 1.0 + values[3].exp())
}

fn check_reference(golden: &Golden) {
    let a = architecture(config(golden));
    let weights = network::weights(&DepthCheckpoint::seeded(a.clone(), config(golden)).unwrap()).unwrap();
    // PyTorch's input was f64.
    let values = golden.u8("in/images_u8").iter().map(|&byte| f64::from(byte) / 255.0).collect();
    let images = Images { values, ..Images::from_u8(&[], golden.shape("in/images_u8")) };
    let (sizes, mut taps) = (sizes(&a), Taps::new());
    let pairs = vggt::pairs(&Scope::of(&weights, "aggregator"), &sizes, &images, &Keys::all(), &mut taps);
    let camera = a.camera_head.as_ref().unwrap();
    let last = pairs.last().unwrap();
    let scope = Scope::of(&weights, "camera_head");
    vggt::cameras(&scope, last, images.views, [camera.depth, camera.heads], &mut taps);
    let mut features = Vec::new();
    for (j, pair) in out_pairs(&a).enumerate() {
        let [frame, global] = &pairs[pair];
        taps.insert(format!("agg/feat{j}"), joined([frame, global], sizes.width));
        features.push(vggt::feature(&pairs[pair], images.views, sizes.width));
    }
    taps.insert("out/pose_enc".into(), taps["cam/pose_enc3"].clone());
    let dense = |head: &str| vggt::dense(&weights, head, &features, &images, sizes.patch).concat();
    if golden.has("out/depth") {
        let logits = dense("depth_head");
        taps.insert("out/depth".into(), logits.iter().step_by(2).map(|x| x.exp()).collect());
        taps.insert("out/depth_conf".into(), logits.iter().skip(1).step_by(2).map(|x| 1.0 + x.exp()).collect());
        let points: Vec<_> = dense("point_head").chunks(4).map(world_point).collect();
        taps.insert("out/world_points".into(), points.iter().flat_map(|(point, _)| *point).collect());
        taps.insert("out/world_points_conf".into(), points.iter().map(|(_, confidence)| *confidence).collect());
    } else if golden.has("depth/logits") {
        let logits = dense("depth_head");
        let view = logits.chunks(logits.len() / images.views);
        let planes = view.flat_map(|view| (0..2).flat_map(move |c| view.iter().skip(c).step_by(2)));
        taps.insert("depth/logits".into(), planes.copied().collect());
    }
    let mut compared = 0;
    for (key, got) in taps.iter().filter(|(key, _)| golden.has(key)) {
        // Depth and points are exponentials.
        let allowed = if key.starts_with("out/") { 2e-6 } else { 5e-7 };
        compare(golden, key, got, Tolerance { max: allowed, rms: allowed / 5.0 });
        compared += 1;
    }
    assert!(compared >= 9, "{}: {compared}", golden.file());
}

/// Token taps: names of the device, and their tokens' parts.
fn check_tokens(golden: &Golden, a: &DepthArchitecture, observed: &Observed) -> usize {
    let tap = |name: String| observed.taps(&name).swap_remove(0);
    let block = |pair: usize, step: usize| tap(format!("bb/block{}", a.backbone.alt_start + 2 * pair + step));
    let mut compared = 0;
    for key in golden.keys().iter().filter(|key| key.starts_with("pe/") || key.starts_with("agg/")) {
        let number = |name: &str| key.strip_prefix(name)?.parse::<usize>().ok();
        let got = match (number("pe/block"), number("agg/frame"), number("agg/global"), number("agg/feat")) {
            (Some(i), ..) => tap(format!("bb/block{i}")),
            (_, Some(i), ..) => block(i, 0),
            (_, _, Some(i), _) => block(i, 1),
            (.., Some(j)) => {
                let pair = out_pairs(a).nth(j).unwrap();
                joined([&block(pair, 0), &block(pair, 1)], a.backbone.width)
            }
            _ if key == "pe/tokens0" => tap("bb/tokens0".into()),
            _ if key == "pe/out" => tap("bb/embedded".into()),
            _ => tap("bb/alt_in".into()),
        };
        compare(golden, key, &got, tolerance(key));
        compared += 1;
    }
    compared
}

/// Encodings, and maps of the last views.
fn check_heads(golden: &Golden, observed: &Observed) -> usize {
    let rectified = |(i, x): (usize, f32)| if i % 9 > 6 { x.max(0.0) } else { x };
    let mut compared = 0;
    for key in golden.keys().iter().filter(|key| ["cam/", "depth/", "point/"].iter().any(|root| key.starts_with(root)))
    {
        let (taps, shape) = (observed.taps(key), golden.shape(key));
        let got: Vec<f32> = if key.starts_with("cam/pose_enc") {
            taps[0].iter().copied().enumerate().map(rectified).collect()
        } else if key.starts_with("cam/") {
            taps[0].clone()
        } else {
            let step = if ["fuse0", "neck", "up"].iter().any(|name| key.ends_with(name)) { 4 } else { 1 };
            let last = &taps[taps.len() - shape[0]..];
            last.iter().flat_map(|tap| planar(tap, step * shape[1], step)).collect()
        };
        let allowed = if key.starts_with("cam/pose_enc") { 2e-5 } else { tolerance(key).max };
        compare(golden, key, &got, Tolerance { max: allowed, rms: allowed });
        compared += 1;
    }
    compared
}

fn check_outputs(golden: &Golden, observed: &Observed) -> usize {
    let (views, cameras) = (&observed.depths.views, observed.depths.cameras().unwrap());
    let extrinsics = cameras.iter().flat_map(|camera| camera.view_matrix().transpose().to_cols_array()[..12].to_vec());
    let lenses = cameras.iter().flat_map(|camera| camera.intrinsics.matrix().transpose().to_cols_array());
    let as_f32 = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x as f32).collect::<Vec<_>>();
    let points = || views.iter().flat_map(|view| view.points.as_ref().expect("a head for points"));
    let (width, height) = (observed.depths.width as usize, observed.depths.height as usize);
    // PyTorch has pixels at whole coordinates.
    let unprojected = views.iter().zip(&cameras).flat_map(|(view, Camera { intrinsics: lens, pose })| {
        let at = (0..height).step_by(4).flat_map(|y| (0..width).step_by(4).map(move |x| (x, y)));
        at.flat_map(|(x, y)| {
            let ray = DVec3::new((x as f64 - lens.cx) / lens.fx, (y as f64 - lens.cy) / lens.fy, 1.0);
            pose.transform(ray * f64::from(view.depth[y * width + x])).to_array()
        })
        .collect::<Vec<_>>()
    });
    let mut found: BTreeMap<&str, (Vec<f32>, f64)> = BTreeMap::new();
    found.insert("out/extrinsics", (as_f32(&mut extrinsics.into_iter()), 2e-5));
    found.insert("out/intrinsics", (as_f32(&mut lenses.into_iter()), 5e-5));
    found.insert("out/depth", (views.iter().flat_map(|view| view.depth.clone()).collect(), 1e-4));
    found.insert("out/depth_conf", (views.iter().flat_map(|view| view.confidence.clone().unwrap()).collect(), 1e-4));
    found.insert("out/world_points", (points().flat_map(|point| point[..3].to_vec()).collect(), 1e-3));
    found.insert("out/world_points_conf", (points().map(|point| point[3]).collect(), 1e-3));
    found.insert("out/unprojected", (as_f32(&mut unprojected.into_iter()), 1e-3));
    let mut compared = 0;
    for (key, (got, allowed)) in found.into_iter().filter(|(key, _)| golden.has(key)) {
        compare(golden, key, &got, Tolerance { max: allowed, rms: allowed });
        compared += 1;
    }
    compared
}

#[test]
fn the_reference_is_pytorch() {
    goldens().for_each(|golden| check_reference(&golden));
}

#[test]
fn vggt_is_pytorch() {
    for golden in goldens() {
        let (a, observed) = (architecture(config(&golden)), Observed::new(&golden));
        let compared =
            [check_tokens(&golden, &a, &observed), check_heads(&golden, &observed), check_outputs(&golden, &observed)];
        assert!(compared.iter().all(|&count| count >= 2), "{}: {compared:?}", golden.file());
    }
}

#[test]
fn positions_and_encodings() {
    let Some(golden) = Golden::open("vggt_units.safetensors") else { return };
    let source = golden.f64("pos/source");
    let embed = [vec![0.0; 2], source].concat();
    let learned: Vec<f32> = embed.iter().map(|x| *x as f32).collect();
    for key in golden.keys().iter().filter(|key| key.starts_with("pos/") && *key != "pos/source") {
        let (rows, columns) = key["pos/".len()..].split_once('x').expect("rows x columns");
        let [rows, columns] = [rows, columns].map(|count| count.parse().unwrap());
        let got = positions::interpolate_antialiased(&embed, 2, rows, columns);
        assert_close(key, &got[2..], &golden.f32(key), Tolerance { max: 1e-6, rms: 2e-7 });
        let got = interpolate_antialiased(&learned, 37, 2, rows, columns);
        assert_close(key, &got[2..], &golden.f32(key), Tolerance { max: 1e-6, rms: 2e-7 });
    }
    let (height, width) = golden.metadata("size_hw").split_once(',').expect("height,width");
    let size = [width, height].map(|side| side.parse().unwrap());
    let decoded = |encoding: &[f32]| decoded_camera(&camera_to_world(encoding.try_into().unwrap()), size);
    let cameras: Vec<Camera> = golden.f32("pose/encoding").chunks(9).map(decoded).collect();
    let extrinsics = cameras.iter().flat_map(|camera| camera.view_matrix().transpose().to_cols_array()[..12].to_vec());
    let lenses = cameras.iter().flat_map(|camera| camera.intrinsics.matrix().transpose().to_cols_array());
    let within = Tolerance { max: 1e-6, rms: 3e-7 };
    assert_close("extrinsics", &extrinsics.collect::<Vec<_>>(), &golden.f64("pose/extrinsics"), within);
    assert_close("intrinsics", &lenses.collect::<Vec<_>>(), &golden.f64("pose/intrinsics"), within);
}

/// Pixels and sums of photos of one size; neither transparency nor padding.
#[test]
fn photos_of_vggt_are_pillows() {
    let Some(golden) = Golden::open("vggt_pre.safetensors") else { return };
    let photos = golden.stems("@sub").into_iter().filter_map(|key| Some(key.strip_prefix("crop/")?.to_owned()));
    let mut compared = 0;
    for name in photos {
        let Some(path) = golden::find(&format!("pre_{name}.png")).filter(|_| !name.contains('+')) else { continue };
        let photo = Image::open(path).unwrap();
        let views = bounded_views(1, |_| Ok(&photo), Fitting::Width, None).unwrap();
        let (found, key) = (&views[0].image, |part: &str| format!("crop/{name}@{part}"));
        let size = [1, i64::from(found.height), i64::from(found.width), 3];
        assert_eq!(golden.i64(&key("size")), size, "{name}");
        assert_eq!(golden.i64(&key("sum")), [found.rgb.iter().map(|&x| i64::from(x)).sum::<i64>()], "{name}");
        let rows = found.rgb.chunks(3 * found.width as usize).step_by(11);
        let kept: Vec<u8> = rows.flat_map(|row| row.chunks(3).step_by(11).flatten()).copied().collect();
        assert_same(&name, &kept, &golden.u8(&key("sub")));
        compared += 1;
    }
    assert!(compared >= 2, "{compared}");
}
