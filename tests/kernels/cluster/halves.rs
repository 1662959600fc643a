use crate::case::*;
use zipsplat::kernels::cluster::Halves;
use zipsplat_tests::reference::cluster::halves::about;

/// Padded, as stored: high and low halves, scales and norms.
struct Held {
    high: Vec<f64>,
    low: Vec<f64>,
    scales: Vec<f32>,
    norms: Vec<f32>,
}

fn held(rows: &[f32], origin: &[f32]) -> Held {
    let width = origin.len();
    let count = rows.len() / width;
    let mut case = plan();
    let out = case.output::<u32>(count * width.next_multiple_of(8));
    let (scales, norms) = (case.output::<f32>(count), case.output::<f32>(count));
    let kernel = Halves {
        source: case.input(rows),
        origin: case.input(origin),
        out,
        scales,
        norms,
        rows: count as u32,
        width: width as u32,
    };
    case.rec.dispatch_groups(kernel, count);
    let run = case.run().unwrap();
    let values = Element::F16.decode(&run.read::<u8>(out).unwrap());
    let half = |which: usize| values.chunks(8).skip(which).step_by(2).flatten().map(|x| f64::from(*x)).collect();
    Held { high: half(0), low: half(1), scales: run.read(scales).unwrap(), norms: run.read(norms).unwrap() }
}

fn check(name: &str, rows: &[f32], origin: &[f32]) {
    let width = origin.len();
    let found = held(rows, origin);
    let (moved, norms) = about(&widen(rows), &widen(origin));
    assert_close(&format!("{name}: norms"), &found.norms, &norms, Tolerance::sum_of(width).and(Tolerance::ELEMENTWISE));
    for (i, row) in moved.chunks(width).enumerate() {
        let (unit, padded) = (f64::from(found.scales[i]), width.next_multiple_of(8));
        assert_eq!(unit.log2().fract(), 0.0, "{name}: row {i} is scaled by {unit}");
        let [high, low] = [&found.high, &found.low].map(|half| &half[i * padded..][..padded]);
        let largest = row.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        assert!(largest <= unit * 32768.0 && (largest == 0.0 || largest >= unit * 16384.0 * (1.0 - 1e-6)), "{name}");
        for (c, x) in row.iter().enumerate() {
            let (h, l) = (high[c] * unit, low[c] * unit);
            // f32 rounds the difference; a device may flush subnormals.
            let (rounding, flushed) = ((-24f64).exp2() * x.abs(), (-28f64).exp2() * largest);
            let [alone, both] = [(-11f64).exp2(), (-22f64).exp2()].map(|unit| unit * x.abs() * 1.001);
            assert!((h - x).abs() <= alone + rounding + flushed, "{name}: row {i}, channel {c}: {h} for {x}");
            assert!((h + l - x).abs() <= both + rounding + flushed, "{name}: row {i}, channel {c}: {h} + {l} for {x}");
        }
        assert!(high[width..].iter().chain(&low[width..]).all(|x| *x == 0.0), "{name}: padding of row {i}");
    }
}

#[test]
fn two_halves_hold_what_one_cannot() {
    if !elements().contains(&Element::F16) {
        return;
    }
    for (rows, width) in [(1, 4), (3, 8), (5, 36), (17, 100), (4, 1536), (33_000, 4)] {
        let origin: Vec<f32> = random(2, width).iter().map(|x| 3.0 * x).collect();
        check(&format!("{rows} x {width}"), &random(1, rows * width), &origin);
    }
    for offset in [1e3, -1e4] {
        let rows: Vec<f32> = random(3, 9 * 64).iter().map(|x| offset + x).collect();
        check(&format!("offset {offset}"), &rows, &[offset; 64]);
    }
}

#[test]
fn rows_of_every_size() {
    if !elements().contains(&Element::F16) {
        return;
    }
    // f32 squares overflow beyond 1e19 and underflow below 1e-19.
    for size in [1e-15, 1e-7, 1.0, 65536.0, 1e10, 1e17] {
        let rows: Vec<f32> = random(4, 5 * 20).iter().map(|x| size * x).collect();
        check(&format!("size {size}"), &rows, &[0.0; 20]);
    }
    // One channel dominates.
    let mut rows = random(5, 6 * 64);
    rows.iter_mut().step_by(64).for_each(|x| *x = 3e3);
    check("outliers", &rows, &[0.0; 64]);
}

#[test]
fn zeros_and_extremes_stay_numbers() {
    if !elements().contains(&Element::F16) {
        return;
    }
    let rows = [[0.0; 8], [f32::MAX; 8], [-f32::MAX; 8], [1e-38; 8], [1e-44; 8]].concat();
    let found = held(&rows, &[0.0; 8]);
    assert!(found.high.iter().chain(&found.low).all(|x| x.is_finite()));
    assert!(found.high[..8].iter().chain(&found.low[..8]).all(|x| *x == 0.0) && found.norms[0] == 0.0);
    assert!(found.scales.iter().all(|x| x.is_normal()));
}
