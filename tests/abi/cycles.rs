use crate::{
    calls::*,
    installation::{runner, success},
};
use std::path::PathBuf;
use zipsplat_c::*;
use zipsplat_tests::processes::resident_bytes;

/// Allocators and drivers occasionally grow; a leak grows in every stretch.
const STRETCHES: usize = 4;
const WARM_UP: usize = 24;
/// In MB, of the least growing stretch.
const LEAST_GROWTH: f64 = 0.5;

fn cycle(cycle: usize) {
    let photos = photos(1);
    let device = open_device();
    let model = model(&device);
    let scene = reconstruct(&model, &[image_of(&photos[0])], &reconstruct_options());
    let renderer = renderer(&device, &scene);
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGBA8);
    let early = draw(&renderer, &camera(32, 32, 0.0), &options, 4);
    let mut objects: [Option<Box<dyn std::any::Any>>; 3] =
        [Some(Box::new(device)), Some(Box::new(model)), Some(Box::new(scene))];
    for i in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]][cycle % 6] {
        objects[i] = None;
    }
    assert_eq!(draw(&renderer, &camera(32, 32, 0.0), &options, 4), early);
}

fn growth(cycles: usize) -> f64 {
    let before = resident_bytes();
    (0..cycles).for_each(cycle);
    (resident_bytes() as f64 - before as f64) / 1e6
}

/// Needs a process without other tests.
#[test]
fn memory_stays_flat() {
    let test = PathBuf::from(std::env::args_os().next().expect("the test's own path"));
    let mut command = runner(&test);
    command.args(["--ignored", "--exact", "cycles::memory_stays_flat_over_many_cycles"]);
    command.env("ZIPSPLAT_CYCLES", "40").env("ZIPSPLAT_VALIDATION", "0");
    success(command);
}

#[test]
fn every_order_of_destruction_works() {
    (0..6).for_each(cycle);
}

/// 1,000 cycles, or `ZIPSPLAT_CYCLES`, of 1 MB of weights: `cargo test --test abi -- --ignored`.
#[test]
#[ignore = "takes minutes"]
fn memory_stays_flat_over_many_cycles() {
    let cycles = std::env::var("ZIPSPLAT_CYCLES").ok().and_then(|cycles| cycles.parse().ok()).unwrap_or(1000);
    let stretch = cycles / STRETCHES;
    (0..WARM_UP).for_each(cycle);
    let growths = [(); STRETCHES].map(|()| growth(stretch));
    eprintln!("grew by {growths:.1?} MB over {stretch} cycles each");
    let least = growths.into_iter().fold(f64::INFINITY, f64::min);
    assert!(
        least < LEAST_GROWTH,
        "grew by {growths:.1?} MB over {stretch} cycles each, expected less than {LEAST_GROWTH} in one"
    );
}
