//! The sort that puts Gaussians in depth order, and the prefix sums in it.

use super::{Area, Case, Mode, Worst, trial::Trial};
use crate::noise::Noise;
use zipsplat::{
    Result,
    gpu::Device,
    ops::{scan::exclusive_scan, sort::sort_pairs},
};

const REASON: &str = "whole numbers: as the stable sort and the running sum of the host, exactly";

fn check_sort(device: &Device, keys: &[u32], bits: u32) -> Result<Worst> {
    let values: Vec<u32> = (0..keys.len() as u32).collect();
    let mut trial = Trial::new(device);
    let (keys_in, values_in) = (trial.input(keys), trial.input(&values));
    let count = trial.input(&[keys.len() as u32]);
    let (sorted_keys, sorted_values) = sort_pairs(&mut trial.rec, keys_in, values_in, count, keys.len(), bits);
    trial.rec.output(sorted_keys);
    trial.rec.output(sorted_values);
    let run = trial.run()?;
    let mut truth: Vec<(u32, u32)> = keys.iter().copied().zip(values).collect();
    truth.sort_by_key(|pair| pair.0);
    let (true_keys, true_values): (Vec<u32>, Vec<u32>) = truth.into_iter().unzip();
    let keys = Worst::differing(&run.read::<u32>(sorted_keys)?, &true_keys);
    Ok(keys.or(Worst::differing(&run.read::<u32>(sorted_values)?, &true_values)))
}

fn check_scan(device: &Device, values: &[u32]) -> Result<Worst> {
    let mut trial = Trial::new(device);
    let tensor = trial.input(values);
    exclusive_scan(&mut trial.rec, tensor, values.len());
    trial.rec.output(tensor);
    let got: Vec<u32> = trial.result(tensor)?;
    let mut sum = 0u32;
    let before = values.iter().map(|&v| {
        sum = sum.wrapping_add(v);
        sum.wrapping_sub(v)
    });
    Ok(Worst::differing(&got, &before.collect::<Vec<_>>()))
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    // A depth as the renderer sorts it: the bits of a positive float.
    let depths = |seed: u64, count: usize| -> Vec<u32> {
        Noise(seed).values(count).into_iter().map(|r| (1.0 + r).mul_add(50.0, 0.01).to_bits()).collect()
    };
    for count in [1, 2, 255, 257, 1025, 100_003] {
        cases.push(Case::new("random depths", count, move |device, _| check_sort(device, &depths(1, count), 32)));
    }
    cases.push(Case::new("equal depths", 20_011, |device, _| check_sort(device, &[1.5f32.to_bits(); 20_011], 32)));
    cases.push(Case::new("few depths", 20_011, move |device, _| {
        let keys: Vec<u32> = depths(2, 20_011).into_iter().map(|bits| bits & 0x7fe0_0000).collect();
        check_sort(device, &keys, 32)
    }));
    cases.push(Case::new("falling", 5_000, |device, _| check_sort(device, &(0..5_000).rev().collect::<Vec<_>>(), 13)));
    cases.push(Case::new("half of all culled", 9_001, move |device, _| {
        let culled = f32::INFINITY.to_bits();
        let keys: Vec<u32> =
            depths(3, 9_001).into_iter().enumerate().map(|(i, bits)| if i % 2 == 0 { culled } else { bits }).collect();
        check_sort(device, &keys, 32)
    }));
    for bits in [1, 5, 9, 17] {
        let name = format!("keys of {bits} bits");
        cases.push(Case::new(name, 3_001, move |device, _| {
            let keys: Vec<u32> = depths(5, 3_001).into_iter().map(|key| key & ((1 << bits) - 1)).collect();
            check_sort(device, &keys, bits)
        }));
    }
    for count in [1, 1023, 1025, 300_001] {
        cases.push(Case::new("prefix sum", count, move |device, _| {
            let values: Vec<u32> = Noise(4).values(count).into_iter().map(|r| (r.abs() * 1e5) as u32).collect();
            check_scan(device, &values)
        }));
    }
    Area { kernel: "ops/sort", size: "keys", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
