use crate::below;
use zipsplat_tests::prelude::*;

/// At parsers' limits.
const NUMBERS: [u64; 14] = [
    0,
    1,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    0x7fff_ffff_ffff_ffff,
    0x8000_0000_0000_0000,
    0xffff_ffff_ffff_ffff,
];

const WORDS: [&str; 16] = [
    "0",
    "-1",
    "1e308",
    "-1e400",
    "NaN",
    "inf",
    "4294967296",
    "18446744073709551616",
    "99999999999999999999999",
    "null",
    "[]",
    "{}",
    "\"\"",
    "[[[[[[[[",
    "\\u0000",
    "0.0000000000000000000000000000000000000000000000001",
];

pub fn mutated(original: &[u8], other: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = original.to_vec();
    for _ in 0..1 + below(random, 4) {
        change(&mut bytes, other, random);
    }
    bytes
}

fn change(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let at = below(random, bytes.len());
    let until = (at + 1 + below(random, 16)).min(bytes.len());
    match below(random, 10) {
        _ if bytes.is_empty() => bytes.extend_from_slice(other),
        0 => bytes[at] ^= 1 << below(random, 8),
        1 => bytes[at] = random.bits() as u8,
        2 => overwrite(bytes, at, &NUMBERS[below(random, NUMBERS.len())].to_le_bytes()[..1 << below(random, 4)]),
        3 => overwrite(bytes, at, &NUMBERS[below(random, NUMBERS.len())].to_be_bytes()[4..]),
        4 => bytes.truncate(at),
        5 => drop(bytes.drain(at..until)),
        6 => {
            let part = bytes[at..until].to_vec();
            let times = 1 + below(random, 40);
            bytes.splice(at..at, part.repeat(times));
        }
        7 => {
            let from = below(random, other.len());
            let part = other[from..(from + 1 + below(random, 200)).min(other.len())].to_vec();
            bytes.splice(at..at, part);
        }
        8 => word(bytes, at, WORDS[below(random, WORDS.len())]),
        _ => {
            let special = [f64::NAN, f64::INFINITY, -1e300, 5e-324][below(random, 4)];
            match below(random, 2) {
                0 => overwrite(bytes, at, &special.to_le_bytes()),
                _ => overwrite(bytes, at, &(special as f32).to_le_bytes()),
            }
        }
    }
}

fn overwrite(bytes: &mut [u8], at: usize, with: &[u8]) {
    let end = (at + with.len()).min(bytes.len());
    bytes[at..end].copy_from_slice(&with[..end - at]);
}

fn word(bytes: &mut Vec<u8>, at: usize, with: &str) {
    let part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-._".contains(byte);
    let start = bytes[..at].iter().rposition(|byte| !part(byte)).map_or(0, |i| i + 1);
    let end = bytes[at..].iter().position(|byte| !part(byte)).map_or(bytes.len(), |i| at + i);
    bytes.splice(start..end, with.bytes());
}
