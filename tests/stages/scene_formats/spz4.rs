//! SPZ version 4, from its description.

use super::{assert_damaged, assert_spz, round_trip, scene};
use zipsplat::types::{SaveOptions, SceneFormat};
use zipsplat_tests::prelude::*;

/// zstd (RFC 8878): one segment, raw blocks, and a run of equal last bytes.
fn frame(content: &[u8]) -> Vec<u8> {
    let mut out = [&0xfd2f_b528u32.to_le_bytes()[..], &[0xa0], &(content.len() as u32).to_le_bytes()].concat();
    let run = content.iter().rev().take_while(|byte| Some(*byte) == content.last()).count();
    let block = |last: bool, kind: u32, size: usize| {
        (u32::from(last) | kind << 1 | (size as u32) << 3).to_le_bytes().into_iter().take(3).collect::<Vec<u8>>()
    };
    for raw in content[..content.len() - run].chunks(5) {
        out.extend([block(false, 0, raw.len()), raw.to_vec()].concat());
    }
    out.extend([block(true, 1, run), vec![content[content.len() - 1]]].concat());
    out
}

/// Extension records precede the table.
fn file(count: u32, sh_degree: u8, records: &[u8], streams: &[&[u8]]) -> Vec<u8> {
    let table = 32 + records.len() as u32;
    let flags = if records.is_empty() { 0 } else { 2 };
    let header = [b"NGSP".as_slice(), &4u32.to_le_bytes(), &count.to_le_bytes()].concat();
    let header = [header, vec![sh_degree, 12, flags, streams.len() as u8], table.to_le_bytes().to_vec()].concat();
    let frames: Vec<Vec<u8>> = streams.iter().map(|stream| frame(stream)).collect();
    let entry = |(frame, plain): (&Vec<u8>, &&[u8])| [frame.len() as u64, plain.len() as u64].map(u64::to_le_bytes);
    let entries: Vec<u8> = frames.iter().zip(streams).flat_map(entry).flatten().collect();
    [header, vec![0; 12], records.to_vec(), entries, frames.concat()].concat()
}

const POSITIONS: [i32; 6] = [4096, -2048, 1, -1, 8191, -4096];
const ALPHAS: [u8; 2] = [0, 255];
const COLORS: [u8; 6] = [0, 255, 51, 102, 153, 204];
const SCALES: [u8; 6] = [0, 160, 255, 16, 32, 48];
/// The identity, and 60 degrees about y.
const ROTATIONS: [u32; 2] = [3 << 30, 3 << 30 | 361 << 10];
const SH: [u8; 18] = [128, 0, 255, 64, 192, 128, 129, 127, 1, 0, 0, 0, 128, 128, 128, 255, 255, 255];

fn with_records(records: &[u8]) -> Vec<u8> {
    let positions: Vec<u8> = POSITIONS.iter().flat_map(|value| value.to_le_bytes().into_iter().take(3)).collect();
    file(2, 1, records, &[&positions, &ALPHAS, &COLORS, &SCALES, ROTATIONS.map(u32::to_le_bytes).as_flattened(), &SH])
}

fn read(bytes: &[u8]) -> Scene {
    Scene::decode(bytes, None).unwrap()
}

#[test]
fn values_are_those_of_the_description() {
    let found = read(&with_records(&[]));
    assert_eq!((found.len(), found.sh_degree), (2, 1));
    // SPZ axes: right, up, back. Ours: right, down, forward.
    let unit = 1.0 / 4096.0;
    assert_eq!(found.means, [[1.0, 0.5, -unit], [-unit, -8191.0 * unit, 1.0]]);
    assert_eq!(found.opacities, [0.0, 1.0]);
    let close = |found: f32, truth: f64| {
        assert!((f64::from(found) - truth).abs() < 1e-5 * (1.0 + truth.abs()), "{found} {truth}")
    };
    for (found, level) in found.scales.as_flattened().iter().zip(SCALES) {
        close(*found, (f64::from(level) / 16.0 - 10.0).exp());
    }
    for (i, level) in COLORS.into_iter().enumerate() {
        close(found.sh_coeffs[4 * (i / 3)][i % 3], (f64::from(level) / 255.0 - 0.5) / 0.15);
    }
    for (i, level) in SH.into_iter().enumerate() {
        // Harmonics y, z and x; two change sign.
        let (gaussian, k, channel) = (i / 9, i / 3 % 3, i % 3);
        let sign = if k < 2 { -1.0 } else { 1.0 };
        close(found.sh_coeffs[4 * gaussian + 1 + k][channel], sign * (f64::from(level) - 128.0) / 128.0);
    }
    let half = 361.0 / 511.0 * 0.5f64.sqrt();
    let quats = [[1.0, 0.0, 0.0, 0.0], [(1.0 - half * half).sqrt(), 0.0, -half, 0.0]];
    found.quats.as_flattened().iter().zip(quats.as_flattened()).for_each(|(found, truth)| close(*found, *truth));
}

/// Type, length, content.
fn record(kind: u32, says: &[u8]) -> Vec<u8> {
    [&kind.to_le_bytes(), &(says.len() as u32).to_le_bytes(), says].concat()
}

#[test]
fn extensions_are_read_over_but_for_other_axes() {
    let plain = read(&with_records(&[]));
    let unknown = record(0x1234_0001, &[7; 13]);
    let usual = record(0xadbe_0003, &4u32.to_le_bytes());
    assert_eq!(read(&with_records(&[&unknown[..], &usual].concat())), plain);
    let turned = [&unknown[..], &record(0xadbe_0003, &6u32.to_le_bytes())].concat();
    assert_damaged("scene.spz", &with_records(&turned), &["byte 61: found axes of number 6, expected 4"]);
    assert_damaged("scene.spz", &with_records(&unknown[..20]), &["expected a whole record"]);
}

#[test]
fn degree_0_has_no_stream_of_harmonics() {
    let rotation = ROTATIONS[0].to_le_bytes();
    let streams: [&[u8]; 5] = [&[0; 9], &[51], &[128; 3], &[160; 3], &rotation];
    let found = read(&file(1, 0, &[], &streams));
    assert_eq!((found.len(), found.sh_degree, found.opacities[0], found.scales[0]), (1, 0, 0.2, [1.0; 3]));
    assert_eq!(read(&file(0, 0, &[], &[])), Scene::default());
}

#[test]
fn ours_keep_what_version_3_keeps() {
    for degree in 0..=3 {
        let truth = scene(degree);
        let options = SaveOptions { spz_version: 4 };
        let found = round_trip(&truth, "scene.spz", &options);
        assert_spz(&found, &truth, 4, 16);
        assert_eq!(found, round_trip(&truth, "scene.spz", &SaveOptions::default()));
        let bytes = truth.encode(SceneFormat::Spz, &options, None).unwrap();
        assert_eq!((&bytes[..5], Scene::decode(&bytes, None).unwrap()), (&b"NGSP\x04"[..], found));
    }
}

#[test]
fn equal_gaussians_come_back() {
    let one = scenes::random_scene(1, 0, 0.1);
    let n = 300_000;
    let many = Scene {
        means: vec![one.means[0]; n],
        scales: vec![one.scales[0]; n],
        quats: vec![one.quats[0]; n],
        opacities: vec![one.opacities[0]; n],
        sh_coeffs: vec![one.sh_coeffs[0]; n],
        ..Scene::default()
    };
    let bytes = many.encode(SceneFormat::Spz, &SaveOptions { spz_version: 4 }, None).unwrap();
    let found = read(&bytes);
    assert!(found.len() == n && found.means.iter().all(|mean| *mean == found.means[0]));
}

#[test]
fn damaged_ones_are_refused() {
    let sound = with_records(&[]);
    let first = 32 + 6 * 16;
    for (at, bytes, reason) in [
        (4, &[5][..], "found version 5 outside a gzip stream, expected 4"),
        (8, &[0xff; 4], "found 4294967295 Gaussians in"),
        (8, &[3], "stream 1 holds 18 bytes, expected 27"),
        (12, &[4], "found degree 4"),
        (12, &[0], "stream 6 holds 18 bytes, expected 0"),
        (13, &[24], "24 fractional bits"),
        (15, &[5], "found 5 streams with values, expected 6"),
        (15, &[255], "the table of 255 streams"),
        (16, &[31], "the table of streams at byte 31"),
        (16, &[0xff; 4], "the table of streams at byte 4294967295"),
        (32, &[0xff; 8], "stream 1 has 18446744073709551615 bytes"),
        (32, &[1], "after the last stream"),
        (40, &[19], "stream 1 holds 19 bytes, expected 18"),
        (first, &[0], "stream 1 of 6: zstd"),
        (first + 5, &[19], "stream 1 of 6: found a frame of 19 bytes, expected 18"),
    ] {
        let mut damaged = sound.clone();
        damaged[at..at + bytes.len()].copy_from_slice(bytes);
        assert_damaged("scene.spz", &damaged, &[reason, "byte "]);
    }
    for length in [4, 31, 33, first, first + 7, sound.len() - 1] {
        assert_damaged("scene.spz", &sound[..length], &["truncated"]);
    }
    assert_damaged("scene.spz", &[&sound[..], &[0]].concat(), &["1 bytes after the last stream"]);
    // The header states the true or the table's size.
    let longer = |content: &[u8], says_so: bool, words: &str| {
        let mut bytes = file(1, 0, &[], &[&[0; 9], content, &[128; 3], &[160; 3], &ROTATIONS[0].to_le_bytes()]);
        bytes[32 + 16 + 8..][..8].copy_from_slice(&1u64.to_le_bytes());
        if !says_so {
            let second = 32 + 5 * 16 + frame(&[0; 9]).len();
            bytes[second + 5..][..4].copy_from_slice(&1u32.to_le_bytes());
        }
        assert_damaged("scene.spz", &bytes, &[words]);
    };
    longer(&[1, 2], true, "stream 2 of 5: found a frame of 2 bytes, expected 1");
    longer(&[1, 2], false, "stream 2 of 5: found more than 1 bytes");
    longer(&[0; 1 << 16], false, "stream 2 of 5");
}
