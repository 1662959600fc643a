use super::{assert_damaged, assert_rotations, assert_within, round_trip, scene};
use glam::DMat4;
use serde_json::{Value, json};
use zipsplat::types::SaveOptions;
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::render::sh;

/// With embedded buffers.
fn document(scene: &Scene) -> Value {
    serde_json::from_slice(&bytes_of("scene.gltf", |path| scene.save(path).unwrap())).unwrap()
}

fn read(document: &Value) -> Scene {
    read_as("scene.gltf", document.to_string(), |path| Scene::open(path).unwrap())
}

#[test]
fn a_round_trip_keeps_all_but_the_length_of_quaternions() {
    for (name, degree) in [("a.glb", 0), ("a.glb", 1), ("a.glb", 2), ("a.glb", 3), ("a.gltf", 0), ("a.gltf", 3)] {
        let truth = scene(degree);
        let found = round_trip(&truth, name, &SaveOptions::default());
        assert_eq!(Scene { quats: truth.quats.clone(), ..found.clone() }, truth, "{name}");
        assert_rotations(&found.quats, &truth.quats, 1e-6);
    }
}

#[test]
fn nodes_turn_move_and_scale() {
    let truth = scene(3);
    let (axis, angle) = (DVec3::new(0.3, -0.5, 0.8).normalize(), 2.1);
    let (outer, inner) = (DQuat::from_axis_angle(axis, angle), DQuat::from_rotation_x(0.7));
    let mut file = document(&truth);
    file["nodes"] = json!([
        { "translation": [1.0, -2.0, 3.0], "rotation": outer.to_array(), "scale": [2.0, 2.0, 2.0], "children": [1] },
        { "matrix": DMat4::from_rotation_translation(inner, DVec3::X).to_cols_array(), "mesh": 0 },
    ]);
    let found = read(&file);
    let axes = DQuat::from_rotation_z(std::f64::consts::PI);
    let to_world = DMat4::from_scale_rotation_translation(DVec3::splat(2.0), outer, DVec3::new(1.0, -2.0, 3.0))
        * DMat4::from_rotation_translation(inner, DVec3::X);
    let rotation = DMat4::from_quat(axes) * to_world * DMat4::from_quat(axes);
    let turn = axes * outer * inner * axes.inverse();
    let means: Vec<f32> = (truth.means.iter())
        .flat_map(|mean| rotation.transform_point3(DVec3::from(mean.map(f64::from))).as_vec3().to_array())
        .collect();
    assert_within("mean", found.means.as_flattened(), &means, |truth| 1e-5 * (1.0 + truth.abs()));
    for i in 0..truth.len() {
        assert!((0..3).all(|c| found.scales[i][c] == 2.0 * truth.scales[i][c]));
        let [rotation, original] =
            [found.quats[i], truth.quats[i]].map(|quat| matrix_from_quaternion(quat.map(f64::from)));
        assert!(rotation.abs_diff_eq(glam::DMat3::from_quat(turn) * original, 1e-6), "rotation {i}");
        for direction in [axis, DVec3::X, DVec3::new(-1.0, 2.0, 0.5).normalize()] {
            let color = |scene: &Scene, direction: DVec3| {
                let coeffs = &scene.sh_coeffs[16 * i..][..16];
                let basis = sh::basis(3, direction);
                basis.iter().zip(coeffs).map(|(basis, rgb)| basis * f64::from(rgb[1])).sum::<f64>()
            };
            assert!((color(&found, turn * direction) - color(&truth, direction)).abs() < 1e-5, "color {i}");
        }
    }
}

#[test]
fn several_primitives_become_one_scene() {
    let truth = scene(1);
    let mut file = document(&truth);
    let mut plain = file["meshes"][0]["primitives"][0].clone();
    plain["attributes"].as_object_mut().unwrap().retain(|name, _| !name.contains("SH_DEGREE_1"));
    let points = json!({ "mode": 0, "attributes": { "POSITION": 0 } });
    file["meshes"][0]["primitives"].as_array_mut().unwrap().extend([points, plain]);
    let found = read(&file);
    assert_eq!((found.len(), found.sh_degree), (2 * truth.len(), 1));
    assert_eq!(found.sh_coeffs[..1600], truth.sh_coeffs);
    assert!(
        found.sh_coeffs[1600..]
            .chunks(4)
            .zip(truth.sh_coeffs.chunks(4))
            .all(|(f, t)| f == [t[0], [0.0; 3], [0.0; 3], [0.0; 3]])
    );
}

#[test]
fn buffers_are_found_beside_the_file_and_nowhere_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("b.gltf");
    let bytes = bytes_of("a.glb", |path| scene(1).save(path).unwrap());
    let json_length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    fs::write(folder.path().join("the numbers.bin"), &bytes[28 + json_length..]).unwrap();
    let mut file: Value = serde_json::from_slice(&bytes[20..20 + json_length]).unwrap();
    file["buffers"][0]["uri"] = "the%20numbers.bin".into();
    fs::write(&path, file.to_string()).unwrap();
    assert_eq!(Scene::open(&path).unwrap().means, scene(1).means);
    let buffer = file["buffers"][0].clone();
    file["buffers"].as_array_mut().unwrap().push(buffer);
    file["bufferViews"][0]["buffer"] = 1.into();
    fs::write(&path, file.to_string()).unwrap();
    assert_eq!(Scene::open(&path).unwrap().means, scene(1).means);
    let escapes = ["../b.bin", "/etc/hostname", "a/../../b.bin", "%2e%2e/b.bin"];
    for uri in escapes.into_iter().chain(["http://host/b.bin", "", "data:,x"]) {
        file["buffers"][0]["uri"] = uri.into();
        assert_damaged("b.gltf", file.to_string().as_bytes(), &["buffer 0"]);
    }
}

#[test]
fn integers_stand_for_fractions() {
    let mut file = document(&scene(0));
    let opacity = file["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:OPACITY"].as_u64().unwrap();
    let opacity = opacity as usize;
    let view = file["accessors"][opacity]["bufferView"].as_u64().unwrap() as usize;
    file["bufferViews"][view]["byteStride"] = 4.into();
    file["accessors"][opacity]["componentType"] = 5121.into();
    file["accessors"][opacity]["normalized"] = true.into();
    let bytes =
        scene(0).opacities.iter().map(|opacity| f32::from(opacity.to_le_bytes()[0]) / 255.0).collect::<Vec<_>>();
    assert_eq!(read(&file).opacities, bytes);
}

#[test]
fn damaged_documents_are_refused() {
    type Spoil = fn(&mut Value);
    let spoils: [(&str, Spoil); 17] = [
        ("version \"1.0\"", |file| file["asset"]["version"] = "1.0".into()),
        ("EXT_x", |file| file["extensionsRequired"] = json!(["EXT_x"])),
        ("accessor 0", |file| file["accessors"][0]["count"] = 401.into()),
        ("accessor 0", |file| file["accessors"][0]["count"] = u64::MAX.into()),
        ("accessor 0", |file| file["accessors"][0]["byteOffset"] = u64::MAX.into()),
        ("accessor 0", |file| file["bufferViews"][0]["byteOffset"] = u64::MAX.into()),
        ("accessor 0", |file| file["bufferViews"][0]["byteStride"] = 0.into()),
        ("accessor 0", |file| file["accessors"][0]["type"] = "VEC2".into()),
        ("accessor 0", |file| file["accessors"][0]["componentType"] = 5125.into()),
        ("expected 400", |file| file["accessors"][2]["count"] = 399.into()),
        ("truncated", |file| file["buffers"][0]["byteLength"] = 10_000_000.into()),
        ("COEF_2", |file| {
            file["meshes"][0]["primitives"][0]["attributes"]
                .as_object_mut()
                .unwrap()
                .retain(|name, _| !name.ends_with("1_COEF_2"));
        }),
        ("kernel", |file| {
            file["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["kernel"] = "disk".into();
        }),
        ("transform", |file| file["nodes"][0]["scale"] = json!([1, 2, 1])),
        ("transform", |file| file["nodes"][0]["scale"] = json!([-1, 1, 1])),
        ("twice", |file| file["nodes"][0]["children"] = json!([0])),
        ("no primitive", |file| file["nodes"] = json!([{}])),
    ];
    for (reason, spoil) in spoils {
        let mut file = document(&scene(1));
        spoil(&mut file);
        assert_damaged("scene.gltf", file.to_string().as_bytes(), &[reason]);
    }
    assert_damaged("scene.gltf", b"{", &["JSON"]);
    let mut shared = document(&scene(0));
    shared["nodes"] = vec![json!({ "mesh": 0 }); 1000].into();
    shared["scenes"][0]["nodes"] = (0..1000).collect();
    assert_damaged("scene.gltf", shared.to_string().as_bytes(), &["expected fewer than bytes"]);
    // 10^10 nodes times primitives.
    let empty = json!({ "attributes": shared["meshes"][0]["primitives"][0]["attributes"],
                        "extensions": shared["meshes"][0]["primitives"][0]["extensions"] });
    shared["meshes"][0]["primitives"] = vec![empty; 10_000].into();
    shared["nodes"] = vec![json!({ "mesh": 0 }); 1_000_000].into();
    shared["scenes"][0]["nodes"] = (0..1_000_000).collect();
    shared["accessors"].as_array_mut().unwrap().iter_mut().for_each(|accessor| accessor["count"] = json!(0));
    assert_damaged("scene.gltf", shared.to_string().as_bytes(), &["no Gaussian"]);
}

#[test]
fn damaged_containers_are_refused() {
    let good = bytes_of("scene.glb", |path| scene(0).save(path).unwrap());
    for length in [4, 11, 19, 30, good.len() - 1] {
        assert_damaged("scene.glb", &good[..length], &[]);
    }
    for (at, reason) in [(4, "version"), (11, "truncated"), (15, "truncated"), (16, "chunk")] {
        let mut bad = good.clone();
        bad[at] = 0x7f;
        assert_damaged("scene.glb", &bad, &[reason]);
    }
    let path = std::env::temp_dir().join("never-written.glb");
    assert!(Scene::default().save(&path).is_err() && !path.exists());
}
