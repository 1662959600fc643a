use crate::case::*;
use zipsplat::kernels::render::{Intersect, TileCounts};

const GRID: [u32; 2] = [11, 7];
const CAMERAS: u32 = 2;

fn tile_sets(pairs: u32) -> Vec<[u32; 3]> {
    let set = |pair: u32| {
        let (x, y) = (pair * 7 % GRID[0], pair * 5 % GRID[1]);
        let (width, height) = (1 + pair * 3 % (GRID[0] - x), 1 + pair % (GRID[1] - y));
        let mask = match width * height {
            area @ 1..=32 if pair.is_multiple_of(3) => pair.wrapping_mul(0x9e37_79b9) & u32::MAX >> (32 - area),
            _ => 0,
        };
        if pair % 5 == 4 { [0; 3] } else { [x | y << 16, width | height << 16, mask] }
    };
    (0..pairs).map(set).collect()
}

/// Returns the tile ids of a set, row-major; a mask of 0 means all.
fn tiles([corner, size, mask]: [u32; 3], camera: u32) -> Vec<u32> {
    let (x, y, width, height) = (corner & 0xffff, corner >> 16, size & 0xffff, size >> 16);
    (0..width * height)
        .filter(|t| mask == 0 || mask >> t & 1 == 1)
        .map(|t| (camera * GRID[1] + y + t / width) * GRID[0] + x + t % width)
        .collect()
}

fn intersect(sets: &[[u32; 3]], indices: &[u32], sums: &[u32], capacity: u32) -> [Vec<u32>; 3] {
    let mut case = plan();
    let kernel = Intersect {
        tile_sets: case.input(sets),
        indices: case.input(indices),
        offsets: case.input(sums),
        tiles: case.output::<u32>(capacity as usize),
        pair_indices: case.output::<u32>(capacity as usize),
        status: case.output::<u32>(3),
        pairs: sets.len() as u32,
        camera_count: CAMERAS,
        grid: GRID,
        capacity,
    };
    case.rec.fill(kernel.status, 0);
    case.rec.dispatch(kernel, sums.len());
    case.results([kernel.tiles, kernel.pair_indices, kernel.status]).unwrap()
}

#[test]
fn lists_every_tile_in_depth_order() {
    for pairs in [1, 63, 64, 65, 1000] {
        let sets = tile_sets(pairs);
        let indices: Vec<u32> = (0..pairs).map(|i| (i * 617 + 3) % pairs).collect();
        let (mut expected_tiles, mut expected_pairs, mut sums) = (Vec::new(), Vec::new(), vec![0]);
        for &pair in &indices {
            let tiles = tiles(sets[pair as usize], pair % CAMERAS);
            expected_pairs.extend(tiles.iter().map(|_| pair));
            expected_tiles.extend(tiles);
            sums.push(expected_tiles.len() as u32);
        }
        let total = expected_tiles.len();
        for capacity in [total + 10, total, total.div_ceil(2)] {
            let [tiles, pair_indices, status] = intersect(&sets, &indices, &sums, capacity as u32);
            let listed = total.min(capacity);
            assert_same("tiles", &tiles[..listed], &expected_tiles[..listed]);
            assert_same("pairs", &pair_indices[..listed], &expected_pairs[..listed]);
            assert_eq!(status, [listed as u32, total as u32, 0]);
        }
    }
}

#[test]
fn counts_every_tile_in_depth_order() {
    let sets = tile_sets(300);
    let indices: Vec<u32> = (0..300).rev().collect();
    let mut case = plan();
    let kernel = TileCounts {
        tile_sets: case.input(&sets),
        indices: case.input(&indices),
        tile_counts: case.output::<u32>(sets.len() + 1),
        pairs: sets.len() as u32,
    };
    case.rec.dispatch(kernel, sets.len() + 1);
    let expected = indices.iter().map(|&i| tiles(sets[i as usize], 0).len() as u32).chain([0]);
    assert_same("counts", &case.result::<u32>(kernel.tile_counts).unwrap(), &expected.collect::<Vec<_>>());
}

#[test]
fn a_sum_that_wraps_is_noticed() {
    let [_, _, status] = intersect(&tile_sets(3), &[0, 1, 2], &[0, 4_000_000_000, 5, 9], 4);
    assert_eq!(status, [4, 9, 1]);
}
