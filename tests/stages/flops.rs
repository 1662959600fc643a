//! FLOPs by stage against PyTorch: twice the multiply-adds of every matrix product and convolution.
//!
//! Photos of 252 x 252 pixels, no known cameras. `flops.csv` has TFLOPs by
//! torch.utils.flop_counter; k-means is five assignments and one search, each of 2 N K D.

use zipsplat::gpu::Profile;
use zipsplat::reconstruct::{Network, NetworkPlan, Shape};
use zipsplat_tests::prelude::*;

const REFERENCE: &str = include_str!("../data/flops.csv");

/// Scopes and kernels of the columns after `tokens`.
const COLUMNS: [(&str, &str); 11] = [
    ("backbone/embed", "ops/linear"),
    ("backbone/block", "ops/attention"),
    ("backbone/features", ""),
    ("cluster", ""),
    ("fuse/cross", "ops/linear"),
    ("fuse/cross", "ops/attention"),
    ("fuse/self", "ops/linear"),
    ("fuse/self", "ops/attention"),
    ("gaussians/color", ""),
    ("gaussians/head", ""),
    ("", ""),
];

/// The backbone's linear layers are one row, except for its features.
fn counted(profile: &Profile, scope: &str, kernel: &str) -> f64 {
    let inside =
        |found: &str| found.starts_with(scope) || scope == "backbone/embed" && found.starts_with("backbone/block");
    let rows = profile.rows.iter().filter(|row| inside(&row.scope) && row.kernel.starts_with(kernel));
    rows.map(|row| row.flops as f64).sum()
}

/// 324 patches pool to 81 keys, plus a camera token. Fusion is not pooled.
#[test]
fn pooled_keys_take_as_much_less() {
    let (limits, architecture) = (Limits::default(), Architecture::named("vits").expect("a variant"));
    let shape = Shape::new(&architecture, 24, [252; 2], Ratio::Auto, &TokenSelection::KMEANS, false).expect("a shape");
    let plan = |shape| {
        let network = Network::new(&architecture, &limits, Arithmetic::EXACT);
        network.plan(&limits, shape).expect("it fits")
    };
    let counts = |made: &NetworkPlan| {
        let profile = Profile::outline(&made.plan);
        ["backbone/block", "fuse/cross", ""].map(|scope| counted(&profile, scope, "ops/attention"))
    };
    let all = plan(shape);
    let before = counts(&all);
    let tokens = 24.0 * 325.0;
    let blocks = (architecture.alt_start..architecture.depth).filter(|block| block % 2 == 1).count();
    let (own, pooled) = (325.0, 24.0 * 82.0);
    for (rule, keys) in
        [("2", pooled), ("2+own", pooled + own), ("2+first", pooled + own - 82.0), ("local", own), ("auto", tokens)]
    {
        let fewer = plan(shape.pooled(rule.parse().expect("a rule")));
        let after = counts(&fewer);
        let each = 4.0 * architecture.width as f64 * tokens * (tokens - keys);
        assert_eq!(before[0] - after[0], blocks as f64 * each, "{rule}");
        assert_eq!(after[1], before[1]);
        assert_eq!(before[2] - after[2], before[0] - after[0]);
        assert_eq!((all.plan.flops() - fewer.plan.flops()) as f64, before[2] - after[2]);
        // Own keys come besides the others.
        assert!(fewer.bytes() <= all.bytes() || rule.ends_with("own"), "{rule}");
    }
}

#[test]
fn plans_state_the_arithmetic_of_the_reference() {
    let limits = Limits::default();
    let arithmetics =
        Precision::ALL.map(|precision| Arithmetic::of(precision, &limits).expect("an ordinary GPU has all"));
    let rows: Vec<Vec<&str>> = REFERENCE.lines().skip(1).map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 4 * 18, "six numbers of views at three ratios");
    for row in rows {
        let &[variant, views, ratio, tokens, ref flops @ ..] = &row[..] else { panic!("{row:?}") };
        let architecture = Architecture::named(variant).expect("a variant");
        let (views, ratio) = (views.parse().unwrap(), ratio.parse().map_or(Ratio::Auto, Ratio::Fixed));
        let shape = Shape::new(&architecture, views, [252; 2], ratio, &TokenSelection::KMEANS, false).unwrap();
        assert_eq!(shape.tokens.to_string(), tokens, "{row:?}");
        assert_eq!(flops.len(), COLUMNS.len(), "{row:?}");
        for arithmetic in arithmetics {
            let mut rec = Recorder::new(&limits);
            Network::new(&architecture, &limits, arithmetic).record(&mut rec, shape);
            let profile = Profile::outline(&rec.finish().expect("a plan"));
            for ((scope, kernel), expected) in COLUMNS.into_iter().zip(flops) {
                let (found, expected) = (counted(&profile, scope, kernel), 1e12 * expected.parse::<f64>().unwrap());
                assert!((found - expected).abs() <= 0.01 * expected, "{row:?}, {scope} {kernel}: {found:.4e}");
            }
        }
    }
}
