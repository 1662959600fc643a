//! FLOPs by stage against PyTorch (`tests/data/flops.md`).

use zipsplat::{
    gpu::{Limits, Profile, Recorder},
    ops::{Arithmetic, Precision},
    reconstruct::{Network, Ratio, Shape, TokenSelection},
    weights::{Architecture, VARIANTS},
};

/// Columns after `Gaussians`, and the engine's scope and kernel. The engine merges some columns.
const COLUMNS: [(&[&str], &str, &str); 11] = [
    (&["bb_linear"], "backbone/embed", "ops/linear"),
    (&["bb_local_attn", "bb_global_attn"], "backbone/block", "ops/attention"),
    (&["prepare"], "backbone/features", ""),
    (&["kmeans"], "cluster", ""),
    (&["ca_linear"], "fuse/cross", "ops/linear"),
    (&["ca_attn"], "fuse/cross", "ops/attention"),
    (&["sa_linear"], "fuse/self", "ops/linear"),
    (&["sa_attn"], "fuse/self", "ops/attention"),
    (&["color"], "gaussians/color", ""),
    (&["head"], "gaussians/head", ""),
    (&["**total**"], "", ""),
];

/// Numbers by column.
fn table(variant: &str) -> Vec<Vec<(String, String)>> {
    let text = include_str!("../data/flops.md");
    let (_, table) = text.split_once(&format!("## {variant} (TFLOPs)")).expect("a table of each variant");
    let cells =
        |line: &str| -> Vec<String> { line.trim_matches('|').split('|').map(|c| c.trim().to_owned()).collect() };
    let mut lines = table.lines().skip_while(|line| !line.starts_with('|')).take_while(|line| line.starts_with('|'));
    let headings = cells(lines.next().expect("headings"));
    lines.skip(1).map(|line| headings.iter().cloned().zip(cells(line)).collect()).collect()
}

fn number(row: &[(String, String)], column: &str) -> f64 {
    let (_, cell) = row.iter().find(|(heading, _)| heading == column).unwrap_or_else(|| panic!("no column {column}"));
    cell.replace([',', '*'], "").parse().unwrap_or_else(|_| panic!("{column}: {cell}"))
}

/// The backbone's linear layers are one row, except for its features.
fn counted(profile: &Profile, scope: &str, kernel: &str) -> f64 {
    let inside =
        |found: &str| found.starts_with(scope) || scope == "backbone/embed" && found.starts_with("backbone/block");
    let rows = profile.rows.iter().filter(|row| inside(&row.scope) && row.kernel.starts_with(kernel));
    rows.map(|row| row.flops as f64).sum()
}

/// 324 patches pool to 81 keys, plus a camera token in global blocks.
#[test]
fn pooled_keys_take_as_much_less() {
    let (limits, architecture) = (Limits::default(), Architecture::named("vits").expect("a variant"));
    let shape =
        Shape::new(&architecture, 24, [252; 2], (Ratio::Auto, &TokenSelection::KMEANS), false).expect("a shape");
    let plan = |shape| {
        let network = Network::new(&architecture, &limits, Arithmetic::EXACT);
        network.plan(&limits, shape).expect("it fits")
    };
    let [all, pooled] = [1, 2].map(|side| plan(shape.pooled(side).expect("a side")));
    let [before, after] = [&all, &pooled].map(|made| {
        let profile = Profile::outline(&made.plan);
        ["backbone/block", "fuse/cross", ""].map(|scope| counted(&profile, scope, "ops/attention"))
    });
    let tokens = 24.0 * 325.0;
    let blocks = (architecture.alt_start..architecture.depth).filter(|block| block % 2 == 1).count();
    let each = 4.0 * architecture.width as f64 * tokens * (tokens - 24.0 * 82.0);
    assert_eq!(before[0] - after[0], blocks as f64 * each);
    assert_eq!(4.0 * after[1], before[1]);
    assert_eq!(before[2] - after[2], before[0] - after[0] + before[1] - after[1]);
    assert_eq!((all.plan.flops() - pooled.plan.flops()) as f64, before[2] - after[2]);
    assert!(pooled.bytes() <= all.bytes());
}

#[test]
fn plans_state_the_arithmetic_of_the_reference() {
    let limits = Limits::default();
    let arithmetics =
        Precision::ALL.map(|precision| Arithmetic::of(precision, &limits).expect("an ordinary GPU has all"));
    let mut compared = 0;
    for variant in VARIANTS {
        let architecture = Architecture::named(variant).expect("a variant");
        for row in table(variant) {
            let views = number(&row, "V") as usize;
            let ratio = match row[1].1.parse() {
                Ok(ratio) => Ratio::Fixed(ratio),
                Err(_) => Ratio::Auto,
            };
            let chosen = (ratio, &TokenSelection::KMEANS);
            let shape = Shape::new(&architecture, views, [252; 2], chosen, false).expect("a shape");
            assert_eq!(shape.tokens as f64, number(&row, "K tokens"), "{variant}, {views} views");
            for arithmetic in arithmetics {
                let mut rec = Recorder::new(&limits);
                Network::new(&architecture, &limits, arithmetic).record(&mut rec, shape);
                let profile = Profile::outline(&rec.finish().expect("a plan"));
                for (columns, scope, kernel) in COLUMNS {
                    let expected: f64 = columns.iter().map(|column| 1e12 * number(&row, column)).sum();
                    let found = counted(&profile, scope, kernel);
                    let what = format!("{variant}, {views} views, {ratio:?}, {columns:?}");
                    assert!(
                        (found - expected).abs() <= 0.01 * expected,
                        "{what}: {found:.4e}, expected {expected:.4e}"
                    );
                    compared += 1;
                }
            }
        }
    }
    assert_eq!(compared, 4 * 18 * arithmetics.len() * COLUMNS.len(), "six numbers of views at three ratios");
}
