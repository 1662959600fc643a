use crate::case::*;
use zipsplat::ops::{
    scan::exclusive_scan,
    sort::{key_starts, sort_pairs},
};

/// Blocks of CPUs and GPUs, on any device.
fn both_blocks() -> [Limits; 2] {
    [true, false].map(|cpu| Limits { cpu, ..device().limits().clone() })
}

fn check(limits: &Limits, keys: &[u32], count: usize, bits: u32) {
    let mut case = plan_within(limits);
    let indices: Vec<u32> = (0..keys.len() as u32).collect();
    let (unsorted, indices, item_count) = (case.input(keys), case.input(&indices), case.input(&[count as u32]));
    let (sorted, order) = sort_pairs(&mut case.rec, unsorted, indices, item_count, keys.len(), bits);
    let [sorted, order] = case.results::<u32, 2>([sorted, order]).unwrap();
    let mut truth: Vec<u32> = (0..count as u32).collect();
    truth.sort_by_key(|&i| keys[i as usize] & ((1u64 << bits) - 1) as u32);
    let name = format!("{count} of {} keys by {bits} bits", keys.len());
    assert_same(&name, &order[..count], &truth);
    let sorted_keys: Vec<u32> = truth.iter().map(|&i| keys[i as usize]).collect();
    assert_same(&name, &sorted[..count], &sorted_keys);
}

fn keys(count: usize) -> Vec<u32> {
    (1..=count as u32).map(|i| i.wrapping_mul(2_654_435_761) ^ i << 7).collect()
}

#[test]
fn sorts_only_the_items_and_bits_in_use() {
    for (count, bits) in [(0, 32), (1, 0), (3_000, 0), (3_000, 1), (3_000, 13), (1, 31), (4_999, 20)] {
        both_blocks().iter().for_each(|limits| check(limits, &keys(5_000), count, bits));
    }
    // More blocks than limits of blocks, and items in a part of them.
    both_blocks().iter().for_each(|limits| check(limits, &keys(1_200_007), 1_100_003, 9));
}

#[test]
fn sums_in_blocks_of_any_size() {
    for count in [1, 255, 256, 257, 2_049, 300_001] {
        let values = keys(count);
        let before = values.iter().scan(0u32, |sum, value| Some(std::mem::replace(sum, sum.wrapping_add(*value))));
        let truth: Vec<u32> = before.collect();
        for limits in both_blocks() {
            let mut case = plan_within(&limits);
            let sums = case.input(&values);
            exclusive_scan(&mut case.rec, sums, count);
            assert_same(&format!("{count} sums"), &case.result::<u32>(sums).unwrap(), &truth);
        }
    }
}

#[test]
fn finds_where_each_key_starts() {
    for (count, key_count) in [(0, 3), (1, 1), (1000, 1), (1000, 100), (5000, 70_000)] {
        // Items beyond `count` are arbitrary.
        let mut keys: Vec<u32> = (0..count).map(|i: u32| i.wrapping_mul(2_654_435_761) % key_count).collect();
        keys.sort_unstable();
        let expected: Vec<u32> = (0..=key_count).map(|key| keys.partition_point(|&k| k < key) as u32).collect();
        keys.resize(count as usize + 5, 0);
        let mut case = plan();
        let (keys, item_count) = (case.input(&keys), case.input(&[count]));
        let starts = key_starts(&mut case.rec, keys, item_count, key_count as usize);
        assert_same("starts", &case.result::<u32>(starts).unwrap(), &expected);
    }
}
