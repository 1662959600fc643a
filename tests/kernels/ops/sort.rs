//! The radix sort of a part of its items and bits, and the starts of keys.

use crate::case::*;
use zipsplat::ops::sort::{key_starts, sort_pairs};

fn check(keys: &[u32], count: usize, bits: u32) {
    let mut case = plan();
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
        check(&keys(5_000), count, bits);
    }
}

#[test]
fn finds_where_each_key_starts() {
    for (count, key_count) in [(0, 3), (1, 1), (1000, 1), (1000, 100), (5000, 70_000)] {
        // Items beyond `count` are unused and arbitrary.
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
