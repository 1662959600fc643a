use crate::prelude::*;
use zipsplat::ops::{scan::exclusive_scan, sort::sort_pairs};

const REASON: &str = "whole numbers: as the stable sort and the running sum of the host, exactly";

/// By their lowest `bits` bits, with indices as values.
struct Sort {
    keys: Vec<u32>,
    bits: u32,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    Zero,
    Shifted,
    LastItem,
    Unstable,
    HighestDigit,
    KeysAlone,
}

type Sorted = [Vec<u32>; 2];

impl Sort {
    /// Stable.
    fn sorted(&self, part: impl Fn(u32) -> u32) -> Vec<(u32, u32)> {
        let mut pairs: Vec<(u32, u32)> = self.keys.iter().copied().zip(0..).collect();
        pairs.sort_by_key(|pair| part(pair.0));
        pairs
    }
}

impl case::Problem for Sort {
    type Output = Sorted;
    type Truth = Sorted;
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Sorted> {
        let count = self.keys.len();
        let values: Vec<u32> = (0..count as u32).collect();
        let mut trial = Trial::new(device);
        let (keys, values) = (trial.input(&self.keys), trial.input(&values));
        let items = trial.input(&[count as u32]);
        let (keys, values) = sort_pairs(&mut trial.rec, keys, values, items, count, self.bits);
        trial.results([keys, values])
    }

    fn truth(&self, _: Mode) -> Sorted {
        let (keys, values) = self.sorted(|key| key).into_iter().unzip();
        [keys, values]
    }

    fn judge(&self, truth: &Sorted, output: &Sorted, _: Mode) -> Worst {
        Worst::differing(&output[0], &truth[0]).or(Worst::differing(&output[1], &truth[1]))
    }

    fn faulty(&self, truth: &Sorted, fault: Fault, _: Mode) -> Vec<Sorted> {
        let count = self.keys.len();
        let mut wrong = truth.clone();
        match fault {
            Fault::Zero => wrong = [vec![u32::MAX; count], vec![u32::MAX; count]],
            Fault::Shifted => wrong.iter_mut().for_each(|items| items.rotate_right(1)),
            Fault::LastItem => wrong[1][count - 1] = u32::MAX,
            Fault::Unstable => {
                let mut pairs = self.sorted(|key| key);
                pairs.sort_by_key(|pair| (pair.0, u32::MAX - pair.1));
                let (keys, values) = pairs.into_iter().unzip();
                wrong = [keys, values];
            }
            Fault::HighestDigit => {
                let mask = (1 << ((self.bits - 1) / 8 * 8)) - 1;
                let (keys, values) = self.sorted(|key| key & mask).into_iter().unzip();
                wrong = [keys, values];
            }
            Fault::KeysAlone => wrong[1] = (0..count as u32).collect(),
        }
        vec![wrong]
    }
}

struct Scan(Vec<u32>);

#[derive(Clone, Copy, Debug)]
enum ScanFault {
    AsItWas,
    Inclusive,
    /// Sums restart here.
    Restarts(usize),
    /// Blocks of 1024 lack the preceding block's sum.
    LastShare,
}

impl Scan {
    fn sums(&self, add: impl Fn(usize, u32) -> u32) -> Vec<u32> {
        let mut sum = 0u32;
        let before = self.0.iter().enumerate().map(|(i, &v)| {
            let before = add(i, sum);
            sum = before.wrapping_add(v);
            before
        });
        before.collect()
    }
}

impl case::Problem for Scan {
    type Output = Vec<u32>;
    type Truth = Vec<u32>;
    type Fault = ScanFault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<u32>> {
        let mut trial = Trial::new(device);
        let tensor = trial.input(&self.0);
        exclusive_scan(&mut trial.rec, tensor, self.0.len());
        trial.result(tensor)
    }

    fn truth(&self, _: Mode) -> Vec<u32> {
        self.sums(|_, sum| sum)
    }

    fn judge(&self, truth: &Vec<u32>, output: &Vec<u32>, _: Mode) -> Worst {
        Worst::differing(output, truth)
    }

    fn faulty(&self, truth: &Vec<u32>, fault: ScanFault, _: Mode) -> Vec<Vec<u32>> {
        if truth.is_empty() {
            return Vec::new();
        }
        vec![match fault {
            ScanFault::AsItWas => self.0.clone(),
            ScanFault::Inclusive => truth.iter().zip(&self.0).map(|(sum, v)| sum.wrapping_add(*v)).collect(),
            ScanFault::Restarts(at) => self.sums(|i, sum| if i == at { 0 } else { sum }),
            ScanFault::LastShare => {
                let lost = |i: usize| {
                    if i < 1024 { 0 } else { truth[i / 1024 * 1024].wrapping_sub(truth[i / 1024 * 1024 - 1024]) }
                };
                truth.iter().enumerate().map(|(i, sum)| sum.wrapping_sub(lost(i))).collect()
            }
        }]
    }
}

/// Positive floats sort as integers.
fn depths(seed: u64, count: usize) -> Vec<u32> {
    Noise::new(seed).values(count).into_iter().map(|r| (1.0 + r).mul_add(50.0, 0.01).to_bits()).collect()
}

pub fn shapes() -> Area {
    let mut area = Area { cases: Vec::new(), ..area() };
    let counts = [1, 2, 7, 8, 9, 255, 256, 257, 1025, 70_001];
    for (count, bits) in counts.map(|count| (count, 32)).into_iter().chain([(1_000_003, 31)]) {
        let make = move || Sort { keys: depths(1, count), bits };
        area.add(format!("random depths by {bits} bits"), count, [Fault::Zero, Fault::LastItem], make);
    }
    // Sums wrap at 2^32.
    let large = |i: usize| (i as u32).wrapping_mul(2_654_435_761) >> (i % 32);
    let scans = move || {
        let counts = [0, 7, 8, 9, 255, 256, 257, 1023, 1024, 1025, 65_537, 1_000_003];
        counts.map(|count| Scan((0..count).map(large).collect())).into()
    };
    area.sweep("prefix sums", 1_000_003, [ScanFault::AsItWas, ScanFault::Inclusive], scans);
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("ops/sort", "keys", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, count: usize, bits: u32, catches: Catches<Fault>, keys: fn(usize) -> Vec<u32>| {
        area.add(name, count, catches, move || Sort { keys: keys(count), bits });
    };
    add("random depths", 1, 32, [Zero, LastItem].into(), |n| depths(1, n));
    let any = || Catches::from([Zero, Shifted, LastItem]);
    add("random depths", 2, 32, any(), |n| depths(1, n));
    for count in [255, 257, 1025, 100_003, 1_100_003] {
        add("random depths", count, 32, any().and(&[HighestDigit, KeysAlone]), |n| depths(1, n));
    }
    add("equal depths", 20_011, 32, any().and(&[Unstable]), |n| vec![1.5f32.to_bits(); n]);
    let ties = || any().and(&[Unstable, HighestDigit, KeysAlone]);
    add("few depths", 20_011, 32, ties(), |n| depths(2, n).into_iter().map(|bits| bits & 0x7fe0_0000).collect());
    add("falling", 5_000, 13, any().and(&[HighestDigit, KeysAlone]), |n| (0..n as u32).rev().collect());
    add("half of all culled", 9_001, 32, ties(), |n| {
        let culled = f32::INFINITY.to_bits();
        depths(3, n).into_iter().enumerate().map(|(i, bits)| if i % 2 == 0 { culled } else { bits }).collect()
    });
    for bits in [1, 5, 9, 17] {
        let make = move || Sort { keys: depths(5, 3_001).into_iter().map(|key| key % (1 << bits)).collect(), bits };
        area.add(format!("keys of {bits} bits"), 3_001, ties(), make);
    }
    use ScanFault::*;
    for count in [1, 1023, 1025, 300_001, 1_100_003] {
        let catches = match count {
            1 => Catches::from([AsItWas, Inclusive]),
            1023 => Catches::from([AsItWas, Inclusive, Restarts(512)]),
            1025 => Catches::from([AsItWas, Inclusive, LastShare, Restarts(1024)]),
            _ => Catches::from([AsItWas, Inclusive, LastShare, Restarts(65_536), Restarts(262_144)]),
        };
        let values = move || Noise::new(4).values(count).into_iter().map(|r| (r.abs() * 1e5) as u32).collect();
        area.add("prefix sum", count, catches, move || Scan(values()));
    }
    area
}
