//! What is destroyed is gone, in whatever order.

use crate::calls::*;
use zipsplat::ffi::*;

/// Create, reconstruct, draw, destroy; the order of destruction depends on `cycle`.
fn cycle(cycle: usize) {
    let photos = photos(1);
    let context = context();
    let model = model(&context);
    let scene = reconstruct(&model, &[image_of(&photos[0])], &reconstruct_options());
    let renderer = renderer(&context, &scene);
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGBA8);
    let early = draw(&renderer, &camera(32, 32, 0.0), &options, 4);
    let mut objects: [Option<Box<dyn std::any::Any>>; 3] =
        [Some(Box::new(context)), Some(Box::new(model)), Some(Box::new(scene))];
    for i in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]][cycle % 6] {
        objects[i] = None;
    }
    // What it is made from is gone, but not what it needs.
    assert_eq!(draw(&renderer, &camera(32, 32, 0.0), &options, 4), early);
}

/// Bytes of this process in memory.
fn resident_bytes() -> u64 {
    let statistics = std::fs::read_to_string("/proc/self/statm").expect("Linux");
    let pages: u64 = statistics.split(' ').nth(1).and_then(|pages| pages.parse().ok()).expect("a number of pages");
    4096 * pages
}

/// Megabytes by which memory grows over `cycles`, after the first have filled caches.
fn growth(cycles: usize) -> f64 {
    (0..12).for_each(cycle);
    let before = resident_bytes();
    (0..cycles).for_each(cycle);
    (resident_bytes() as f64 - before as f64) / 1e6
}

#[test]
fn every_order_of_destruction_works() {
    (0..6).for_each(cycle);
}

/// Alone in its process: `cargo test --test abi -- --ignored memory`. A leak of one picture a cycle would be 4 MB.
#[test]
#[ignore = "takes minutes"]
fn memory_stays_flat_over_1000_cycles() {
    let first = growth(500);
    let second = growth(500);
    eprintln!("{first:.1} MB over the first 500 cycles, {second:.1} MB over the second");
    assert!(second < 2.0, "grew by {first:.1} MB, then by {second:.1} MB");
}
