use zipsplat::{depth::DepthNetwork, gpu::Profile, weights::DepthArchitecture};
use zipsplat_tests::prelude::*;

/// Giga multiply-adds per view: network, size, depth and ray branch.
const HEADS: [(&str, [u32; 2], f64, f64); 4] = [
    ("da3-small", [504, 336], 7.1, 8.6),
    ("da3-small", [252, 252], 2.7, 3.2),
    ("da3-base", [504, 336], 25.4, 33.4),
    ("da3-base", [252, 252], 9.5, 12.5),
];
/// Tera operations: network, size, views.
const BACKBONES: [(&str, [u32; 2], usize, f64); 4] = [
    ("da3-small", [504, 336], 4, 0.26),
    ("da3-small", [504, 336], 24, 3.8),
    ("da3-base", [504, 336], 4, 0.81),
    ("da3-base", [252, 252], 24, 2.1),
];

fn profile(name: &str, size: [u32; 2], views: usize) -> Profile {
    let (architecture, limits) = (DepthArchitecture::named(name).unwrap(), Limits::default());
    let network = DepthNetwork::new(&architecture, &limits, Arithmetic::EXACT);
    let shape = network.shape(views, size, Ratio::Fixed(1.0), &TokenSelection::KMEANS, false, None).unwrap();
    Profile::outline(&network.plan(&limits, shape).unwrap().0)
}

/// Tolerates half of the last digit, and 1 %.
fn assert_near(what: &str, found: f64, stated: f64, digit: f64) {
    let allowed = 0.5 * digit + 0.01 * stated;
    assert!((found - stated).abs() <= allowed, "{what}: {found:.3}, stated {stated}");
}

#[test]
fn heads_do_what_is_stated() {
    for (name, size, depth, rays) in HEADS {
        let profile = profile(name, size, 1);
        let giga = |scope: &str| profile.total(scope).1 as f64 / 2e9;
        // Mixing channels before upsampling saves three quarters.
        let features = DepthArchitecture::named(name).unwrap().features as f64;
        let patches = f64::from(size[0] / 14 * (size[1] / 14));
        let larger = [64.0, 16.0, 4.0, 1.0].map(|times| times * patches).iter().sum::<f64>();
        let deepest = f64::from((size[0] / 14).div_ceil(2) * (size[1] / 14).div_ceil(2));
        let ours = [16.0, 4.0, 1.0].map(|times| times * patches).iter().sum::<f64>() + deepest;
        let saved = (larger - ours) * features * features / 1e9;
        let what = format!("{name} at {size:?}");
        assert_near(&format!("{what}, depth"), giga("heads/levels") + giga("heads/depth") + saved, depth, 0.1);
        assert_near(&format!("{what}, rays"), giga("heads/rays") + saved, rays, 0.1);
    }
}

#[test]
fn backbones_do_what_is_stated() {
    for (name, size, views, stated) in BACKBONES {
        let found = profile(name, size, views).total("backbone").1 as f64 / 1e12;
        assert_near(
            &format!("{name} at {size:?}, {views} views"),
            found,
            stated,
            if stated < 1.0 { 0.01 } else { 0.1 },
        );
    }
}

#[test]
fn scratch_of_heads_is_of_one_view() {
    let architecture = DepthArchitecture::named("da3-base").unwrap();
    let limits = Limits::default();
    let network = DepthNetwork::new(&architecture, &limits, Arithmetic::EXACT);
    let bytes = |views: usize| {
        let shape = network.shape(views, [504, 336], Ratio::Fixed(1.0), &TokenSelection::KMEANS, false, None).unwrap();
        network.plan(&limits, shape).unwrap().0.arena_bytes()
    };
    let (few, many) = (bytes(4), bytes(8));
    // A view: four features, a block's tensors, 2 values a pixel, 7 a ray.
    let (tokens, width) = (24 * 36, 768);
    let features = 4 * 4 * 2 * tokens * width;
    let outputs = 4 * (2 * 504 * 336 + 7 * 64 * tokens);
    assert!(many - few < 4 * (2 * features + outputs) as u64, "{few} bytes of 4 views, {many} of 8");
}
