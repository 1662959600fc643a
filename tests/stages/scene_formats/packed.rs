//! Packed PLY of SuperSplat and PlayCanvas, from its description.

use super::{assert_damaged, assert_within};
use zipsplat_tests::prelude::*;

/// A chunk and a part.
const COUNT: usize = 300;

/// Including both ends.
fn level(i: usize, field: u32, bound: u32) -> u32 {
    match i % 9 {
        0 => 0,
        1 => bound - 1,
        _ => (i as u32).wrapping_mul(2_654_435_761).wrapping_add(field * 40_503) % bound,
    }
}

fn range(chunk: usize, property: usize) -> [f32; 2] {
    let low = -1.5 + 0.25 * property as f32 + chunk as f32;
    [low, low + 0.5 * (1 + property % 3) as f32]
}

fn words(i: usize) -> [u32; 4] {
    let third = |field| level(i, field, 2048) << 21 | level(i, field + 1, 1024) << 11 | level(i, field + 2, 2048);
    // The fourth is the largest.
    let rotation = (i as u32 % 4) << 30 | (0..3).fold(0, |bits, c| bits << 10 | (256 + level(i, 6 + c, 512)));
    let color = (0..4).fold(0, |bits, c| bits << 8 | level(i, 9 + c, 256));
    [third(0), rotation, third(3), color]
}

fn sh_level(i: usize, property: usize) -> u8 {
    level(i, 20 + property as u32, 256) as u8
}

/// `rest` coefficients above degree 0, optionally with color ranges.
fn file(rest: usize, colors: bool) -> Vec<u8> {
    let axes = |prefix: &str, axes: [&str; 3]| -> Vec<String> {
        ["min", "max"].iter().flat_map(|end| axes.map(|axis| format!("{end}_{prefix}{axis}"))).collect()
    };
    let mut names = [axes("", ["x", "y", "z"]), axes("scale_", ["x", "y", "z"])].concat();
    if colors {
        names.extend(axes("", ["r", "g", "b"]));
    }
    let properties = |kind: &str, names: &[String]| -> String {
        names.iter().map(|name| format!("property {kind} {name}\n")).collect()
    };
    let packed = ["position", "rotation", "scale", "color"].map(|name| format!("packed_{name}"));
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment made here\nelement chunk 2\n{}element vertex {COUNT}\n{}",
        properties("float", &names),
        properties("uint", &packed)
    );
    if rest > 0 {
        let names: Vec<String> = (0..3 * rest).map(|i| format!("f_rest_{i}")).collect();
        header += &format!("element sh {COUNT}\n{}", properties("uchar", &names));
    }
    let mut out = (header + "end_header\n").into_bytes();
    for chunk in 0..2 {
        for three in 0..names.len() / 6 {
            for end in 0..2 {
                (0..3).for_each(|axis| out.extend(range(chunk, 3 * three + axis)[end].to_le_bytes()));
            }
        }
    }
    (0..COUNT).for_each(|i| out.extend(words(i).map(u32::to_le_bytes).as_flattened()));
    (0..COUNT).for_each(|i| out.extend((0..3 * rest).map(|property| sh_level(i, property))));
    out
}

fn expected(rest: usize, colors: bool) -> Scene {
    let mut scene = Scene { sh_degree: (rest + 1).isqrt() as u32 - 1, ..Scene::default() };
    for i in 0..COUNT {
        let value = |property: usize, level: u32, levels: u32| {
            let [low, high] = range(i / 256, property).map(f64::from);
            low + (high - low) * f64::from(level) / f64::from(levels - 1)
        };
        let three = |first: usize, field: u32| {
            [(2048, 0), (1024, 1), (2048, 2)].map(|(n, c)| value(first + c as usize, level(i, field + c, n), n))
        };
        scene.means.push(three(0, 0).map(|x| x as f32));
        scene.scales.push(three(3, 3).map(|x| x.exp() as f32));
        let mut quat: Vec<f64> =
            (0..3).map(|c| (f64::from(256 + level(i, 6 + c, 512)) / 1023.0 - 0.5) * 2f64.sqrt()).collect();
        quat.insert(i % 4, (1.0 - quat.iter().map(|q| q * q).sum::<f64>()).sqrt());
        scene.quats.push(std::array::from_fn(|c| quat[c] as f32));
        let color = |c: u32| {
            let level = level(i, 9 + c, 256);
            let seen = if colors { value(6 + c as usize, level, 256) } else { f64::from(level) / 255.0 };
            ((seen - 0.5) / 0.282_094_791_773_878_14) as f32
        };
        scene.sh_coeffs.push([color(0), color(1), color(2)]);
        scene.opacities.push(level(i, 12, 256) as f32 / 255.0);
        for k in 0..rest {
            scene.sh_coeffs.push([0, 1, 2].map(|channel| match sh_level(i, channel * rest + k) {
                0 => -4.0,
                255 => 4.0,
                level => ((f64::from(level) + 0.5) / 32.0 - 4.0) as f32,
            }));
        }
    }
    scene
}

#[test]
fn values_are_those_of_the_description() {
    for (rest, colors) in [(0, true), (0, false), (3, true), (8, false), (15, true)] {
        let (found, truth) = (Scene::decode(&file(rest, colors), None).unwrap(), expected(rest, colors));
        assert_eq!((found.len(), found.sh_degree), (COUNT, truth.sh_degree));
        let close = |name: &str, found: &[f32], truth: &[f32]| {
            assert_within(&format!("{name}, {rest}"), found, truth, |truth| 2e-6 * (1.0 + truth.abs()));
        };
        close("means", found.means.as_flattened(), truth.means.as_flattened());
        close("scales", found.scales.as_flattened(), truth.scales.as_flattened());
        close("quats", found.quats.as_flattened(), truth.quats.as_flattened());
        close("opacities", &found.opacities, &truth.opacities);
        close("sh_coeffs", found.sh_coeffs.as_flattened(), truth.sh_coeffs.as_flattened());
    }
}

#[test]
fn damaged_ones_are_refused() {
    let sound = file(3, true);
    let end = sound.windows(11).position(|bytes| bytes == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&sound[..end]).unwrap();
    for (from, to, reason) in [
        ("chunk 2", "chunk 1", "found 1 chunks for 300 Gaussians, expected 2, each of 256"),
        ("vertex 300", "vertex 256", "found 2 chunks for 256 Gaussians, expected 1"),
        ("vertex 300", "vertex 4000000000", "truncated: the header promises 4000000000 vertices of 16 bytes"),
        ("sh 300", "sh 299", "found 299 rows of sh, expected one for each of 300 vertices"),
        ("sh 300", "sh 9999999", "truncated: the header promises 9999999 rows of sh of 9 bytes"),
        ("element chunk 2", "element piece 2", "names no chunk element"),
        ("uint packed_scale", "float packed_scale", "vertex, packed_scale: found float, expected uint"),
        ("uint packed_color", "uint packed_tints", "no property packed_color"),
        ("float max_scale_y", "float most_scale_y", "element chunk has no property max_scale_y"),
        ("uchar f_rest_8", "uchar f_8", "8 f_rest properties, expected 0, 9, 24 or 45"),
        ("binary_little_endian", "ascii", "vertex, packed_position: found float, expected uint"),
    ] {
        assert!(header.contains(from));
        assert_damaged("scene.ply", &[header.replace(from, to).as_bytes(), &sound[end..]].concat(), &[reason]);
    }
    for length in [end, end + 100, sound.len() - 1] {
        assert_damaged("scene.ply", &sound[..length], &["truncated"]);
    }
    let (top, elements) = header.split_at(header.find("element chunk").unwrap());
    let (chunk, rest) = elements.split_at(elements.find("element vertex").unwrap());
    let swapped = [top, &rest[..rest.len() - 11], chunk, "end_header\n"].concat();
    let words = "found element vertex before element chunk";
    assert_damaged("scene.ply", &[swapped.as_bytes(), &sound[end..]].concat(), &[words]);
    let mut bad = sound;
    bad[end..end + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_damaged("scene.ply", &bad, &["256 of 300 Gaussians otherwise, the first is 0"]);
}
