use zipsplat::types::{read_ply, write_ply};
use zipsplat_tests::prelude::*;

fn goldens() -> Golden {
    Golden::committed("geometry.safetensors")
}

fn scene(count: usize, sh_degree: u32) -> Scene {
    let width = 11 + 3 * (sh_degree as usize + 1).pow(2);
    let unit = |i: usize| ((i as u32).wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 24) as f32;
    let value = |i: usize| match i % width {
        0..3 => 10.0 * unit(i) - 5.0,
        3..6 => 0.01 + unit(i),
        10 => 0.02 + 0.96 * unit(i),
        _ => 2.0 * unit(i) - 0.9,
    };
    Scene::from_packed(&(0..count * width).map(value).collect::<Vec<_>>(), sh_degree).unwrap()
}

#[track_caller]
fn assert_round_trip(name: &str, found: &Scene, truth: &Scene) {
    assert_eq!((found.len(), found.sh_degree), (truth.len(), truth.sh_degree), "{name}");
    assert_eq!(
        (&found.means, &found.quats, &found.sh_coeffs),
        (&truth.means, &truth.quats, &truth.sh_coeffs),
        "{name}"
    );
    // Logarithms up to 14 are off by 1e-6.
    let tolerance = Tolerance { max: 3e-6, rms: 1e-6 };
    assert_close(name, found.scales.as_flattened(), truth.scales.as_flattened(), tolerance);
    assert_close(name, &found.opacities, &truth.opacities, tolerance);
}

fn read(bytes: &[u8]) -> Result<Scene, Error> {
    read_as("scene.ply", bytes, |path| read_ply(path))
}

#[track_caller]
fn assert_format_error(bytes: &[u8], reason: &str) {
    assert_malformed("scene.ply", bytes, |path| read_ply(path), &[reason]);
}

fn written(scene: &Scene) -> Vec<u8> {
    bytes_of("scene.ply", |path| write_ply(scene, path).unwrap())
}

/// Allows an ulp: PyTorch's vectorized logarithm is not correctly rounded.
#[track_caller]
fn assert_same_but_for_logarithms(name: &str, found: &[u8], truth: &[u8]) {
    let body = header_len(truth);
    assert_eq!(String::from_utf8_lossy(&found[..body]), String::from_utf8_lossy(&truth[..body]), "{name}");
    assert_eq!(found.len(), truth.len(), "{name}");
    let columns = String::from_utf8_lossy(&truth[..body]).matches("property float").count();
    let bits = |bytes: &[u8]| -> Vec<u32> {
        bytes.chunks_exact(4).map(|bytes| u32::from_le_bytes(bytes.try_into().unwrap())).collect()
    };
    let (mut found, truth) = (bits(&found[body..]), bits(&truth[body..]));
    for (i, (found, truth)) in found.iter_mut().zip(&truth).enumerate() {
        let is_scale = (columns - 7..columns - 4).contains(&(i % columns));
        if is_scale && found.abs_diff(*truth) == 1 {
            *found = *truth;
        }
    }
    assert_same(name, &found, &truth);
}

fn header_len(bytes: &[u8]) -> usize {
    let line = b"end_header";
    let start = bytes.windows(line.len()).position(|window| window == line).unwrap();
    start + bytes[start..].iter().position(|&byte| byte == b'\n').unwrap() + 1
}

#[test]
fn files_are_the_references_byte_for_byte() {
    let golden = goldens();
    for degree in 0..=2 {
        let scene = Scene::from_packed(&golden.f32(&format!("ply/deg{degree}")), degree).unwrap();
        let path = golden::find(&format!("gaussians_deg{degree}.ply")).unwrap();
        let truth = fs::read(&path).unwrap();
        assert_same_but_for_logarithms(&format!("degree {degree}"), &written(&scene), &truth);

        let mut clamped = scene.clone();
        clamped.opacities.iter_mut().for_each(|opacity| *opacity = opacity.clamp(1e-6, 1.0 - 1e-6));
        clamped.scales.iter_mut().flatten().for_each(|scale| *scale = scale.max(1e-6));
        assert_round_trip(&format!("degree {degree}"), &read_ply(&path).unwrap(), &clamped);
    }
}

#[test]
fn packed_rows_are_taken_apart_in_order() {
    let golden = goldens();
    for degree in 0..=2 {
        let rows = golden.f32(&format!("ply/deg{degree}"));
        let scene = Scene::from_packed(&rows, degree).unwrap();
        scene.validate().unwrap();
        assert_eq!(packed(&scene), rows);
    }
    let mut scaled = Scene::from_packed(&golden.f32("ply/deg1"), 1).unwrap();
    scaled.scale(2.5);
    assert_close("scaled", &packed(&scaled), &golden.f32("ply/scaled_by_2.5_deg1"), Tolerance::STORED);
    assert!(Scene::from_packed(&[0.0; 22], 1).is_err());
    assert!(Scene::from_packed(&[0.0; 22], 4).is_err());
    assert!(Scene::from_packed(&[], 3).unwrap().is_empty());
}

#[test]
fn scenes_survive_a_file() {
    for (count, degree) in [(0, 1), (1, 0), (1000, 3), (70_000, 1)] {
        let scene = scene(count, degree);
        assert_round_trip(&format!("{count} of degree {degree}"), &read(&written(&scene)).unwrap(), &scene);
    }
}

/// Properties (type, name) in another order.
fn rewritten(
    scene: &Scene,
    format: &str,
    properties: &[(&str, String)],
    mut put: impl FnMut(&str, &str, f32, &mut Vec<u8>),
) -> Vec<u8> {
    let bytes = written(scene);
    let end = header_len(&bytes);
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let count = scene.len();
    let mut out = format!("ply\r\nformat {format} 1.0\r\ncomment made by hand\r\nelement vertex {count}\r\n");
    for (scalar, name) in properties {
        out += &format!("property {scalar} {name}\r\n");
    }
    let mut out = (out + "element face 0\r\nproperty list uchar int vertex_indices\r\nend_header\r\n").into_bytes();
    for row in bytes[end..].chunks(4 * names.len()) {
        let floats: Vec<f32> = row.chunks(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
        for (scalar, name) in properties {
            let value = names.iter().position(|column| column == name).map_or(7.0, |column| floats[column]);
            put(scalar, name, value, &mut out);
        }
    }
    out
}

fn foreign_properties() -> Vec<(&'static str, String)> {
    let rest = (0..9).rev().map(|i| ("double", format!("f_rest_{i}")));
    let others =
        ["rot_3", "f_dc_1", "y", "scale_2", "opacity", "rot_1", "z", "f_dc_0", "rot_0", "x", "scale_0", "rot_2"]
            .map(|name| ("float", name.to_string()));
    let more = [("uchar", "red"), ("float32", "f_dc_2"), ("int16", "id"), ("float64", "scale_1"), ("int", "cluster")];
    let more = more.map(|(scalar, name)| (scalar, name.to_string()));
    others.into_iter().chain(rest).chain(more).collect()
}

#[test]
fn foreign_files_are_read() {
    let scene = scene(50, 1);
    let binary =
        rewritten(&scene, "binary_little_endian", &foreign_properties(), |scalar, _, value, out| match scalar {
            "uchar" => out.push(value as u8),
            "int16" => out.extend((value as i16).to_le_bytes()),
            "int" => out.extend((value as i32).to_le_bytes()),
            "double" | "float64" => out.extend(f64::from(value).to_le_bytes()),
            _ => out.extend(value.to_le_bytes()),
        });
    assert_round_trip("shuffled, typed, with others between", &read(&binary).unwrap(), &scene);
    let ascii = rewritten(&scene, "ascii", &foreign_properties(), |_, _, value, out| {
        out.extend(format!("{value:?} ").into_bytes());
    });
    assert_round_trip("ASCII", &read(&ascii).unwrap(), &scene);
    assert_format_error(&ascii[..ascii.len() - 40], "truncated");
    assert_format_error(&ascii.iter().map(|&byte| if byte == b'.' { b'x' } else { byte }).collect::<Vec<_>>(), "");

    let header_end = header_len(&binary);
    let text = String::from_utf8(binary[..header_end].to_vec()).unwrap();
    let behind =
        text.replace("element vertex", "element chunk 2\nproperty float min\nproperty uchar bits\nelement vertex");
    let behind = [behind.as_bytes(), &[0x55; 10], &binary[header_end..]].concat();
    assert_round_trip("behind another element", &read(&behind).unwrap(), &scene);
}

#[test]
fn color_without_view_dependence_needs_no_f_rest() {
    let scene = scene(3, 0);
    let kept = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let properties: Vec<_> = (kept.map(String::from).into_iter())
        .chain((0..4).map(|i| format!("rot_{i}")))
        .map(|name| ("float", name))
        .collect();
    let put = |_: &str, _: &str, value: f32, out: &mut Vec<u8>| out.extend(value.to_le_bytes());
    assert_round_trip(
        "no normals",
        &read(&rewritten(&scene, "binary_little_endian", &properties, put)).unwrap(),
        &scene,
    );
    for missing in 0..properties.len() {
        let mut fewer = properties.clone();
        let (_, name) = fewer.remove(missing);
        let bytes = rewritten(&scene, "binary_little_endian", &fewer, put);
        assert_format_error(&bytes, &format!("no property {name}"));
    }
}

#[test]
fn malformed_files_are_refused_without_allocating_by_their_counts() {
    let bytes = written(&scene(5, 1));
    let end = header_len(&bytes);
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let with = |from: &str, to: &str| [header.replace(from, to).as_bytes(), &bytes[end..]].concat();

    for kept in [0, 2, 40, end - 1, end, end + 1, bytes.len() - 1] {
        assert_format_error(&bytes[..kept], "");
    }
    assert_format_error(&bytes[..bytes.len() - 1], "truncated: the header promises 5 vertices");
    for count in ["6", "1000000000000", "18446744073709551615", "-1", "many", "99999999999999999999"] {
        assert_format_error(&with("vertex 5", &format!("vertex {count}")), "");
        let ascii = header.replace("binary_little_endian", "ascii").replace("vertex 5", &format!("vertex {count}"));
        assert_format_error(&[ascii.as_bytes(), &bytes[end..]].concat(), "");
    }
    assert_format_error(&with("binary_little_endian", "binary_big_endian"), "big_endian");
    assert_format_error(&with("property float x", "property half x"), "unknown type");
    assert_format_error(&with("property float x", "property list uchar float x"), "list");
    assert_format_error(&with("element vertex 5", ""), "before any element");
    assert_format_error(&with("element vertex", "element point"), "no vertex element");
    assert_format_error(&with("property float f_rest_8", "property float rest"), "8 f_rest properties");
    assert_format_error(&with("ply\n", "obj\n"), "\"ply\"");
    assert_format_error(&with("end_header", "end_of_header"), "");
    assert!(matches!(read_ply("no/such.ply"), Err(Error::Io { path, .. }) if path == Path::new("no/such.ply")));
}

#[test]
fn values_that_are_no_numbers_are_counted() {
    type Spoil = fn(&mut Scene, usize);
    let spoils: [(&str, Spoil); 8] = [
        ("means", |scene, i| scene.means[i][2] = f32::NAN),
        ("means", |scene, i| scene.means[i][0] = f32::INFINITY),
        ("scales", |scene, i| scene.scales[i][1] = f32::NAN),
        ("scales", |scene, i| scene.scales[i][1] = -0.5),
        ("quats", |scene, i| scene.quats[i] = [0.0; 4]),
        ("opacities", |scene, i| scene.opacities[i] = f32::NAN),
        ("opacities", |scene, i| scene.opacities[i] = 1.5),
        ("sh_coeffs", |scene, i| scene.sh_coeffs[4 * i + 3][1] = f32::NEG_INFINITY),
    ];
    for (field, spoil) in spoils {
        let mut bad = scene(10, 1);
        spoil(&mut bad, 4);
        spoil(&mut bad, 7);
        assert_refused(bad.validate(), &[field, "2 of 10", "first is 4"]);
        let path = std::env::temp_dir().join("never-written.ply");
        assert!(matches!(write_ply(&bad, &path), Err(Error::Argument { .. })) && !path.exists());
    }
    let mut bytes = written(&scene(10, 1));
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_format_error(&bytes, "1 of 10");
    let mut short = scene(10, 1);
    short.quats.pop();
    assert!(short.validate().is_err());
}

#[test]
fn the_most_visible_of_each_token_stay() {
    let whole = scene(10, 1);
    let mut kept = whole.clone();
    kept.keep_most_visible(4, 2);
    // Two of each four and of the partial group.
    assert_eq!(kept.len(), 6);
    kept.validate().unwrap();
    let shows = |scene: &Scene, i: usize| {
        let mut scales = scene.scales[i];
        scales.sort_by(f32::total_cmp);
        scene.opacities[i] * scales[1] * scales[2]
    };
    let mut place = 0;
    for (i, mean) in kept.means.iter().enumerate() {
        place += whole.means[place..].iter().position(|other| other == mean).expect("in the order of before");
        assert_eq!(kept.sh_coeffs[4 * i..4 * i + 4], whole.sh_coeffs[4 * place..4 * place + 4]);
        assert_eq!(
            (kept.scales[i], kept.quats[i], kept.opacities[i]),
            (whole.scales[place], whole.quats[place], whole.opacities[place])
        );
        let group = place / 4 * 4..(place / 4 * 4 + 4).min(10);
        assert!(group.filter(|other| shows(&whole, *other) > shows(&whole, place)).count() < 2, "Gaussian {place}");
        place += 1;
    }
    let mut same = whole.clone();
    same.keep_most_visible(4, 4);
    assert_eq!(same, whole);
}
