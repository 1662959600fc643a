use crate::case::*;
use zipsplat::ops::{LaneTile, Tile, Tiles, Units};
use zipsplat::tune::{Measured, Tuning};

#[test]
fn measures_every_tile_and_can_be_stopped() {
    let limits = device().limits();
    let (mut last, mut first) = (0.0, String::new());
    let mut tuning = Tuning::default();
    let outcome = tuning.measure(device(), |tile, done| {
        assert!((last..=1.0).contains(&done), "{done} after {last}");
        last = done;
        if first.is_empty() {
            first = tile.to_owned();
        }
        ControlFlow::Continue(())
    });
    outcome.unwrap();
    assert_eq!(tuning.unusable, Vec::<String>::new());
    let has = |factor| tuning.measured.iter().any(|m| m.kernel == "linear" && m.factor == factor);
    assert!(has(Element::F32), "on lanes");
    assert!(Element::HALVES.iter().all(|half| has(*half) == limits.half_storage), "on matrix units or lanes");
    for measured in &tuning.measured {
        let candidates = match (measured.kernel.as_str(), Units::of(measured.factor, limits)) {
            ("linear", Some(units)) => Tile::linear(limits, units).len(),
            ("linear", None) => LaneTile::candidates(limits, measured.factor).len(),
            ("attention", Some(units)) => Tile::attention(limits, units, Tile::TUNED_CHANNELS).len(),
            ("nearest", Some(units)) => Tile::nearest(limits, units).len(),
            other => panic!("{other:?} has no tiles"),
        };
        // Larger sizes skip tiles already known to be slow.
        let alike = tuning.measured.iter().filter(|m| (&m.kernel, m.factor) == (&measured.kernel, measured.factor));
        let smallest = alike.map(|m| m.values).min() == Some(measured.values);
        let least = if smallest { candidates } else { 1 };
        assert!((least..=candidates).contains(&measured.tiles.len()), "{measured:?}");
        assert!(measured.tiles.iter().all(|(_, ms)| *ms > 0.0), "{measured:?}");
    }
    let known = tuning.clone();
    let stopped = tuning.measure(device(), |_, _| ControlFlow::Break(()));
    assert!(matches!(stopped, Err(Error::Cancelled)), "{stopped:?}");
    assert_eq!(tuning, known, "what was known stays");
    let mut others = Tuning { unusable: vec![first.clone()], ..Tuning::default() };
    let stopped = others.measure(device(), |tile, _| {
        assert_ne!(tile, first, "it is not tried again");
        ControlFlow::Break(())
    });
    assert!(matches!(stopped, Err(Error::Cancelled)), "{stopped:?}");
}

#[test]
fn the_fastest_tile_is_taken() {
    let limits = device().limits();
    let Some(fast) = Arithmetic::of(Precision::Fp16, limits) else { return };
    let Some(units) = fast.linear else { return };
    let names: Vec<String> = Tile::linear(limits, units).iter().map(ToString::to_string).collect();
    let tuning = |best: &str| {
        let tiles =
            names.iter().cloned().chain([best.into()]).map(|name| (name.clone(), if name == best { 1.0 } else { 2.0 }));
        let measured =
            Measured { kernel: "linear".into(), factor: Element::F16, values: 1 << 14, tiles: tiles.collect() };
        Tuning { measured: vec![measured], ..Tuning::default() }
    };
    for (index, name) in names.iter().enumerate() {
        let tuned = tuning(name).applied(fast, limits);
        assert_eq!(
            tuned.linear.unwrap().tiles,
            Tiles::always(index),
            "also of larger results, which were not measured"
        );
        assert_eq!(tuned.attention, fast.attention, "which was not measured");
    }
    assert_eq!(tuning("a tile of another version").applied(fast, limits), fast);
    assert_eq!(kept(&tuning(&names[0])), tuning(&names[0]));
}

#[test]
fn the_fastest_tile_of_lanes_is_taken_for_f32() {
    let limits = device().limits();
    let tiles = LaneTile::candidates(limits, Element::F32);
    let exact = Arithmetic::EXACT;
    for (index, best) in tiles.iter().enumerate() {
        let times = tiles.iter().map(|tile| (tile.to_string(), if tile == best { 1.0 } else { 2.0 }));
        let (kernel, values) = ("linear".into(), 1 << 14);
        let measured = vec![Measured { kernel, factor: Element::F32, values, tiles: times.collect() }];
        let tuned = |arithmetic| Tuning { measured: measured.clone(), ..Tuning::default() }.applied(arithmetic, limits);
        let tiles = Tiles::always(index);
        assert_eq!(tuned(exact), Arithmetic { tiles, exact_tiles: tiles, ..exact });
        if let Some(fast) = Arithmetic::of(Precision::Fp16, limits) {
            assert_eq!(tuned(fast), Arithmetic { exact_tiles: tiles, ..fast }, "of f16 nothing was measured");
        }
    }
}

fn kept(tuning: &Tuning) -> Tuning {
    serde_json::from_slice(&serde_json::to_vec(tuning).unwrap()).unwrap()
}
