use crate::{Mode, modes, noise};
use zipsplat_cli::metrics::psnr;
use zipsplat_tests::prelude::*;

fn views(count: u32) -> Vec<Image> {
    (0..count).map(|i| noise(56, 42, u64::from(i) + 1)).collect()
}

/// As `views` equal blocks with block `from[i]` in place i.
fn fields(scene: &Scene, views: usize, from: &[usize]) -> [(&'static str, Vec<f32>); 5] {
    let order = |values: &[f32]| -> Vec<f32> {
        let block = values.len() / views;
        from.iter().flat_map(|&view| &values[view * block..][..block]).copied().collect()
    };
    scenes::fields(scene).map(|(name, values)| (name, order(values)))
}

#[track_caller]
fn in_every_mode(check: fn(&Mode)) {
    modes().iter().for_each(check);
}

#[test]
fn permuting_views_beyond_the_first_permutes_tokens() {
    in_every_mode(|mode| {
        let images = views(4);
        let order = [0, 3, 1, 2];
        let permuted = order.map(|i| images[i].clone());
        let [plain, moved] =
            [&images[..], &permuted].map(|images| mode.reconstruct(images, &ReconstructOptions::default()));
        // Sums are reordered: both are within the tolerance.
        let expected = fields(&plain, 4, &order);
        for ((field, expected), (_, got)) in expected.iter().zip(fields(&moved, 4, &[0, 1, 2, 3])) {
            assert_close(field, &got, expected, mode.tolerance(field).times(2.0));
        }
        let draw = |scene: &Scene| {
            let frames =
                Renderer::new(device()).render_scene(scene, &[camera(64, 48)], &RenderOptions::default()).unwrap();
            frames[0].rgb.clone().unwrap()
        };
        // In f32, a parameter error of 1e-4 is 80 dB. With narrower factors both may deviate: 6 dB
        // more.
        let alike = psnr(&draw(&plain), &draw(&moved));
        let least = if mode.arithmetic == Arithmetic::EXACT {
            60.0
        } else {
            ImageTolerance::of_network(mode.arithmetic).psnr - 6.1
        };
        assert!(alike > least, "{:?}: {alike} dB", mode.arithmetic);
        // The first view is the reference.
        let swapped = [1, 0, 2, 3].map(|i| images[i].clone());
        let other = mode.reconstruct(&swapped, &ReconstructOptions::default());
        let (means, others) = (fields(&plain, 4, &[1, 0, 2, 3]), fields(&other, 4, &[0, 1, 2, 3]));
        assert!(
            means[0].1.iter().zip(&others[0].1).any(|(a, b)| (a - b).abs() > 1e-2),
            "the first view is like others"
        );
    });
}

#[test]
fn every_token_is_what_no_clustering_gives() {
    in_every_mode(|mode| {
        let images = views(2);
        let all = mode.reconstruct(&images, &ReconstructOptions::default());
        let tokens = 2 * 4 * 3;
        for selection in [
            TokenSelection::Given((0..tokens).collect()),
            TokenSelection::KMEANS,
            TokenSelection::MutualNearest,
            TokenSelection::Stride,
            TokenSelection::Random(5),
        ] {
            let given = mode.reconstruct(&images, &networks::options(1.0, selection.clone()));
            for ((field, truth), (_, got)) in fields(&all, 1, &[0]).iter().zip(fields(&given, 1, &[0])) {
                assert_same(&format!("{selection:?} {field}"), &bits(&got), &bits(truth));
            }
        }
    });
}

#[test]
fn chosen_tokens_come_in_the_order_asked_for() {
    in_every_mode(|mode| {
        let images = views(2);
        let request = |indices: &[u32]| ReconstructOptions {
            token_selection: TokenSelection::Given(indices.to_vec()),
            ..ReconstructOptions::default()
        };
        let [rising, falling] =
            [&[2, 7, 11, 20][..], &[20, 11, 7, 2]].map(|indices| mode.reconstruct(&images, &request(indices)));
        let expected = fields(&rising, 4, &[3, 2, 1, 0]);
        for ((field, expected), (_, got)) in expected.iter().zip(fields(&falling, 4, &[0, 1, 2, 3])) {
            assert_close(field, &got, expected, mode.tolerance(field).times(2.0));
        }
    });
}

#[test]
fn duplicated_views_give_the_same_gaussians() {
    in_every_mode(|mode| {
        let images = views(3);
        let doubled = [0, 1, 2, 1].map(|i| images[i].clone());
        let scene = mode.reconstruct(&doubled, &ReconstructOptions::default());
        // Equal views: sums have the same terms in the same order.
        let (first, second) = (fields(&scene, 4, &[1]), fields(&scene, 4, &[3]));
        for ((field, first), (_, second)) in first.iter().zip(second) {
            assert_same(field, &bits(&second), &bits(first));
        }
    });
}

fn all() -> RenderOptions {
    RenderOptions { alpha: true, depth: Some(Depth::Accumulated), ..RenderOptions::default() }
}

fn draw(scene: &Scene, width: u32) -> RenderOutput {
    Renderer::new(device()).render_scene(scene, &[camera(width, 48)], &all()).unwrap().remove(0)
}

#[test]
fn a_mirrored_scene_is_the_mirrored_picture() {
    let scene = random_scene(1_000, 0, 0.1);
    let mut mirrored = scene.clone();
    mirrored.means.iter_mut().for_each(|mean| mean[0] = -mean[0]);
    // A reflection in x inverts rotations about y and z.
    mirrored.quats.iter_mut().for_each(|quat| (quat[2], quat[3]) = (-quat[2], -quat[3]));
    let (plain, mirrored) = (draw(&scene, 64).rgb.unwrap(), draw(&mirrored, 64).rgb.unwrap());
    let flipped: Vec<f32> =
        mirrored.chunks(3 * 64).flat_map(|row| row.chunks(3).rev().flatten().copied().collect::<Vec<_>>()).collect();
    let alike = psnr(&plain, &flipped);
    assert!(alike > 90.0, "{alike} dB");
    assert!(psnr(&plain, &mirrored) < 40.0, "the scene is its own mirror image");
}

#[test]
fn opaque_layers_hide_what_is_behind() {
    let front = random_scene(500, 0, 0.2);
    let mut wall = front.clone();
    for i in 0..10 {
        wall.means.push([0.0, 0.0, 0.5 + 0.01 * i as f32]);
        wall.scales.push([20.0, 20.0, 1e-4]);
        wall.quats.push([1.0, 0.0, 0.0, 0.0]);
        wall.opacities.push(1.0);
        wall.sh_coeffs.push([0.3, 0.2, 0.1]);
    }
    let mut alone = wall.clone();
    for field in [&mut alone.means, &mut alone.scales, &mut alone.sh_coeffs] {
        field.drain(..500);
    }
    alone.quats.drain(..500);
    alone.opacities.drain(..500);
    assert_same("rgb", &bits(&draw(&wall, 64).rgb.unwrap()), &bits(&draw(&alone, 64).rgb.unwrap()));
}

/// `sigma` in pixels, before a camera of focal length 64, at exact quarter pixels and depths 1, 2
/// and 4.
fn exactly_placed(count: usize, sigma: f32) -> Scene {
    let mut scene = random_scene(count, 1, 0.1);
    for i in 0..count {
        let depth = [1.0, 2.0, 4.0][i % 3];
        let [x, y, z] = scene.means[i];
        let quarters = |along: f32| (256.0 * along).round() / 256.0 * depth;
        scene.means[i] = [quarters(x / z), quarters(y / z), depth];
        scene.scales[i] = [sigma, 0.7 * sigma, 0.4 * sigma].map(|s| s * depth / 64.0);
    }
    scene
}

#[test]
fn tiles_apart_are_the_picture_together() {
    let (width, height) = (64, 48);
    // Projection clamps Gaussians beyond 0.15 of a part from its edge; they must not reach it, 3.4
    // deviations away.
    for (size, [part_width, part_height]) in [(0.4, [16, 16]), (1.0, [32, 48]), (1.0, [32, 24]), (0.6, [32, 16])] {
        let scene = exactly_placed(3_000, size);
        let whole = draw(&scene, width as u32);
        let mut renderer = Renderer::new(device());
        renderer.set_scene(&scene).unwrap();
        let (mut rgb, mut alpha) = (vec![0.0; 3 * width * height], vec![0.0; width * height]);
        for (left, top) in (0..height / part_height).flat_map(|y| (0..width / part_width).map(move |x| (x, y))) {
            let (left, top) = (left * part_width, top * part_height);
            let mut part = camera(width as u32, height as u32);
            (part.intrinsics.width, part.intrinsics.height) = (part_width as u32, part_height as u32);
            part.intrinsics.cx -= left as f64;
            part.intrinsics.cy -= top as f64;
            let frame = renderer.render(&[part], &all()).unwrap().remove(0);
            for y in 0..part_height {
                let (from, to) = (y * part_width, (top + y) * width + left);
                alpha[to..][..part_width].copy_from_slice(&frame.alpha.as_ref().unwrap()[from..][..part_width]);
                let row = &frame.rgb.as_ref().unwrap()[3 * from..][..3 * part_width];
                rgb[3 * to..][..3 * part_width].copy_from_slice(row);
            }
        }
        let name = format!("{part_width} x {part_height}");
        assert_same(&format!("{name} rgb"), &bits(&rgb), &bits(whole.rgb.as_ref().unwrap()));
        assert_same(&format!("{name} alpha"), &bits(&alpha), &bits(whole.alpha.as_ref().unwrap()));
        assert!(alpha.iter().filter(|a| **a > 0.5).count() > 100, "{name}: little to see");
    }
}
