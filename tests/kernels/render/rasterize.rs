//! Blending against brute force, from reference splats.

use crate::case::*;
use zipsplat::{kernels::limits::TILE, kernels::render::Rasterize};
use zipsplat_tests::{reference::render::project::Splat, reference::render::rasterize};

const SIZE: [usize; 2] = [37, 21];

fn splats() -> Vec<Splat> {
    let wave = |i: usize, step: f64| 0.5 + 0.5 * (i as f64 * step).sin();
    let splat = |i: usize| {
        let (a, c) = (0.5 + 60.0 * wave(i, 1.3).powi(3), 0.5 + 60.0 * wave(i, 2.1).powi(3));
        let b = 0.95 * (2.0 * wave(i, 0.7) - 1.0) * (a * c).sqrt();
        let determinant = a * c - b * b;
        Splat {
            mean: [50.0 * wave(i, 3.7) - 5.0, 30.0 * wave(i, 5.9) - 5.0],
            depth: 1.0 + 0.01 * i as f64,
            conic: [c / determinant, -b / determinant, a / determinant],
            opacity: wave(i, 0.9),
            compensation: 1.0,
            radii: [0; 2],
            tiles: [[0; 2]; 2],
            color: [wave(i, 1.0), wave(i, 1.1), wave(i, 1.2)],
        }
    };
    (0..150).map(splat).collect()
}

/// Color, alpha and depth; normal and token color if `all`.
fn draw<const CHANNELS: usize>(splats: &[Splat], runs: u32, batched: bool, all: bool) -> Vec<[f32; CHANNELS]> {
    let grid = SIZE.map(|pixels| pixels.div_ceil(TILE as usize));
    let tiles = grid[0] * grid[1];
    let every: Vec<u32> = (0..tiles).flat_map(|_| 0..splats.len() as u32).collect();
    let each = |f: fn(&Splat) -> [f64; 3]| -> Vec<[f32; 3]> { splats.iter().map(|s| f(s).map(|v| v as f32)).collect() };
    // The kernel's conic: see kernels/render/project.comp.
    let completed = |s: &Splat| {
        let [a, b, c] = s.conic;
        [a, -b / a, c - b * b / a]
    };
    let mut case = plan();
    let kernel = Rasterize {
        pair_indices: case.input(&every),
        tile_offsets: case.input(&(0..=tiles).map(|t| (t * splats.len()) as u32).collect::<Vec<_>>()),
        xy_opacities: case.input(&each(|s| [s.mean[0], s.mean[1], s.opacity])),
        conics: case.input(&each(completed)),
        colors: case.input(&each(|s| s.color)),
        depths: case.input(&splats.iter().map(|s| s.depth as f32).collect::<Vec<_>>()),
        normals: case.input(&each(|s| s.color.map(|x| 0.5 - x))),
        frames: case.output::<[f32; CHANNELS]>(SIZE[0] * SIZE[1]),
        size: SIZE.map(|pixels| pixels as u32),
        grid: grid.map(|tiles| tiles as u32),
        first_tile_row: 0,
        row_count: SIZE[1] as u32,
        background: [0.1, 0.2, 0.3],
        runs,
        color: true,
        has_background: true,
        alpha: true,
        depth: true,
        expected_depth: true,
        normal: all,
        token_pairs: if all { 3 } else { 0 },
        batched,
    };
    case.rec.dispatch_groups(kernel, [grid[0] as u32 * all_runs() / runs, grid[1] as u32, 1]);
    case.result(kernel.frames).unwrap()
}

fn all_runs() -> u32 {
    TILE * TILE / device().limits().subgroup_size
}

#[test]
fn equals_brute_force_for_any_number_of_runs() {
    let splats = splats();
    let truth = rasterize::rasterize(&splats.iter().copied().map(Some).collect::<Vec<_>>(), SIZE, [0.1, 0.2, 0.3]);
    for runs in [1, 2, all_runs()] {
        let frames = draw::<5>(&splats, runs, false, false);
        let hold = |what: &str, values: Vec<f32>, truth: &[f64], unstable: &[u8], tolerance| {
            let picture = Picture { values: &values, width: SIZE[0], channels: truth.len() / unstable.len() };
            assert_images_close(&format!("{runs} runs {what}"), picture, truth, unstable, tolerance);
        };
        let rgb = frames.iter().flat_map(|pixel| pixel[..3].to_vec()).collect();
        hold("rgb", rgb, &truth.rgb, &truth.unstable, ImageTolerance::RGB);
        hold("alpha", frames.iter().map(|p| p[3]).collect(), &truth.alpha, &truth.unstable, ImageTolerance::RGB);
        let depth = frames.iter().map(|p| p[4]).collect();
        hold("depth", depth, &truth.expected_depth, &truth.unstable, ImageTolerance::EXPECTED_DEPTH);
    }
}

#[test]
fn batches_have_the_same_bits() {
    // Opaque splats end tiles within a batch.
    let opaque = |splat: Splat| Splat { opacity: 1.0, ..splat };
    for splats in [splats(), splats().into_iter().map(opaque).collect(), splats()[..5].to_vec(), Vec::new()] {
        for runs in [1, 2, all_runs()] {
            let bits =
                |batched| draw::<11>(&splats, runs, batched, true).as_flattened().iter().map(|x| x.to_bits()).collect();
            let [each, batches]: [Vec<u32>; 2] = [false, true].map(bits);
            assert_same(&format!("{} splats in {runs} runs", splats.len()), &batches, &each);
        }
    }
}
