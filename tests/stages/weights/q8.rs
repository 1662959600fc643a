use super::{assert_same_bits, malformed::assert_reason, pico_weights, read};
use safetensors::{Dtype as FileDtype, SafeTensors};
use zipsplat::{ops::Q8, reconstruct::Network, weights::Ffn};
use zipsplat_tests::architectures::golden;
use zipsplat_tests::prelude::*;

fn saved(checkpoint: &Checkpoint, dtype: Dtype) -> Vec<u8> {
    bytes_of("weights.safetensors", |path| checkpoint.save(path, dtype).unwrap())
}

fn opened(bytes: Vec<u8>) -> Checkpoint {
    Checkpoint::from_bytes("q8.safetensors", bytes, None).unwrap()
}

fn seeded(name: &str) -> Checkpoint {
    Checkpoint::seeded_architecture(golden(name), name).unwrap()
}

#[test]
fn a_file_keeps_every_integer_and_scale() {
    let of = seeded("micro");
    let bytes = saved(&of, Dtype::Q8);
    let q8 = opened(bytes.clone());
    let names: Vec<&str> = q8.q8_names().collect();
    let is_matrix = |name: &&str| matches!(of.shape(name).unwrap(), [_, inner] if inner % Q8::GROUP == 0);
    assert_eq!(names, of.tensor_names().filter(|name| name.ends_with(".weight")).filter(is_matrix).collect::<Vec<_>>());
    assert!(names.len() > 20, "{names:?}");
    for name in of.tensor_names() {
        let (exact, found) = (read(&of, name), read(&q8, name));
        if names.contains(&name) {
            let rounded = Q8::round(&exact).unwrap();
            assert!(q8.read_q8(name).unwrap() == rounded, "{name}");
            let scale = |i: usize| rounded.scales[i / Q8::GROUP].to_f32();
            let apart = exact.iter().zip(&found).enumerate().all(|(i, (a, b))| (a - b).abs() <= 0.5001 * scale(i));
            assert!(apart && exact != found, "{name}");
        } else {
            // Exact in f16.
            assert!(exact == found, "{name}");
        }
    }
    assert!(saved(&q8, Dtype::Q8) == bytes, "nothing is rounded twice");
    assert_same_bits(&opened(saved(&q8, Dtype::F32)), &q8);
    let expected = (of.bytes() as f64 * 0.25 * 1.0625) as u64;
    assert!((expected..expected * 3 / 2).contains(&q8.bytes()), "{} of {}", q8.bytes(), of.bytes());
}

#[test]
fn any_reader_of_safetensors_opens_it() {
    let of = seeded("micro");
    let bytes = saved(&of, Dtype::Q8);
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let name = "backbone.backbone.blocks.0.attn.qkv.weight";
    let [integers, scales] = ["q8", "q8_scales"].map(|end| file.tensor(&format!("{name}.{end}")).unwrap());
    assert_eq!((integers.dtype(), integers.shape()), (FileDtype::I8, &[192, 64][..]));
    assert_eq!((scales.dtype(), scales.shape()), (FileDtype::F16, &[192, 2][..]));
    let scales: Vec<f32> =
        scales.data().as_chunks().0.iter().map(|bytes| half::f16::from_le_bytes(*bytes).to_f32()).collect();
    let values = integers.data().iter().enumerate().map(|(i, byte)| f32::from(*byte as i8) * scales[i / 32]);
    assert!(values.eq(read(&opened(bytes.clone()), name)));
    let other = |name: &str| file.tensor(name).unwrap().dtype();
    assert_eq!(other("backbone.backbone.blocks.0.attn.qkv.bias"), FileDtype::F32);
    assert_eq!(other("backbone.backbone.patch_embed.proj.weight"), FileDtype::F16);
}

fn file(integers: (&str, &str), scales: (&str, &str, &[u8])) -> Vec<u8> {
    let size = |dtype: &str, shape: &str| {
        let sides = shape.trim_matches(['[', ']']).split(',').map(|side| side.parse::<usize>().unwrap());
        sides.product::<usize>() * if dtype.ends_with('8') { 1 } else { 2 }
    };
    let first = size(integers.0, integers.1);
    let last = first + size(scales.0, scales.1);
    let json = format!(
        "{{\"x.q8\":{{\"dtype\":\"{}\",\"shape\":{},\"data_offsets\":[0,{first}]}},\"x.q8_scales\":{{\"dtype\":\"{}\",\
         \"shape\":{},\"data_offsets\":[{first},{last}]}}}}",
        integers.0, integers.1, scales.0, scales.1
    );
    let mut values = vec![0; last];
    values[first..][..scales.2.len()].copy_from_slice(scales.2);
    [&(json.len() as u64).to_le_bytes(), json.as_bytes(), &values].concat()
}

#[test]
fn files_that_are_no_weights_of_8_bits() {
    let whole = ("F16", "[2,1]", &[][..]);
    assert_reason(&file(("U8", "[2,32]"), whole), "x: found type U8, expected I8");
    assert_reason(&file(("F16", "[2,32]"), whole), "x: found type F16, expected I8");
    assert_reason(&file(("I8", "[2,20]"), whole), "[2, 20], expected rows of whole groups of 32");
    assert_reason(&file(("I8", "[64]"), whole), "[64], expected rows of whole groups of 32");
    assert_reason(&file(("I8", "[2,32]"), ("F16", "[1,2]", &[])), "found scales [1, 2] of f16, expected [2, 1] of f16");
    assert_reason(
        &file(("I8", "[2,32]"), ("BF16", "[2,1]", &[])),
        "found scales [2, 1] of bf16, expected [2, 1] of f16",
    );
    let alone = "{\"x.q8\":{\"dtype\":\"I8\",\"shape\":[1,32],\"data_offsets\":[0,32]}}";
    let alone = [&(alone.len() as u64).to_le_bytes(), alone.as_bytes(), &[0; 32]].concat();
    assert_reason(&alone, "x: found no scales beside it");
}

#[test]
fn scales_that_no_device_would_hold_are_refused() {
    let of = seeded("micro");
    let name = "backbone.backbone.blocks.0.attn.qkv.weight";
    let good = saved(&of, Dtype::Q8);
    let scales = SafeTensors::deserialize(&good).unwrap().tensor(&format!("{name}.q8_scales")).unwrap().data().as_ptr();
    let at = scales as usize - good.as_ptr() as usize;
    for scale in [f32::NAN, f32::INFINITY, -1.0, 600.0, 1e-6] {
        let mut bytes = good.clone();
        bytes[at + 2..][..2].copy_from_slice(&half::f16::from_f32(scale).to_le_bytes());
        assert_refused(opened(bytes).read_q8(name), &[name, "scale 1"]);
    }
    let large = |value: f32| Q8::round(&[[value; 1].as_slice(), &[0.0; 31]].concat());
    assert!(large(6.4e4).is_some() && large(-7e4).is_none());
}

/// All tokens of two photos.
fn scene(checkpoint: &Checkpoint, arithmetic: Arithmetic) -> Scene {
    let photo = |seed| {
        let values = random(seed, 3 * 28 * 42).into_iter().map(|x| (127.5 + 127.0 * x) as u8).collect();
        Image::new(42, 28, values).unwrap()
    };
    let go_on = |_: f64| ControlFlow::Continue(());
    let model = Model::from_checkpoint_with(device(), checkpoint, arithmetic, go_on).unwrap();
    let made = model
        .reconstruct_views(&[photo(1), photo(2)], &ReconstructOptions::default(), |_| ControlFlow::Continue(()))
        .unwrap();
    made.to_scene().unwrap()
}

#[test]
fn a_network_computes_with_what_the_integers_stand_for() {
    let gated = Architecture { ffn: Ffn::SwiGlu, ffn_hidden: 160, ..golden("micro") };
    let gated = Checkpoint::seeded_architecture(gated, "gated").unwrap();
    for of in [seeded("micro"), gated] {
        let q8 = opened(saved(&of, Dtype::Q8));
        let expanded = opened(saved(&q8, Dtype::F32));
        let [got, truth] = [&q8, &expanded].map(|checkpoint| scene(checkpoint, Arithmetic::EXACT));
        let bits = |scene: &Scene| scene.means.as_flattened().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_same("means", &bits(&got), &bits(&truth));
        assert_same("colors", got.sh_coeffs.as_flattened(), truth.sh_coeffs.as_flattened());
        assert!(scene(&of, Arithmetic::EXACT).means != got.means, "and not with the weights before");
        for arithmetic in fast_arithmetics().into_iter().filter(|arithmetic| !arithmetic.has_integers()) {
            let fast = scene(&q8, arithmetic);
            let square = |x: f32| f64::from(x).powi(2);
            let apart = truth.means.as_flattened().iter().zip(fast.means.as_flattened());
            let apart: f64 = apart.map(|(a, b)| square(a - b)).sum();
            let size: f64 = truth.means.as_flattened().iter().map(|a| square(*a)).sum();
            let most = 32.0 * arithmetic.element.roundoff();
            assert!((apart / size).sqrt() < most, "{arithmetic:?}: {} of {most}", (apart / size).sqrt());
        }
    }
}

#[test]
fn they_stay_small_on_the_device_and_are_not_rounded_twice() {
    let limits = Limits::default();
    let of = Checkpoint::seeded("vits", None).unwrap();
    let q8 = opened(saved(&of, Dtype::Q8));
    let bytes =
        |checkpoint: &Checkpoint| Network::of(checkpoint, &limits, Arithmetic::EXACT).unwrap().weight_bytes() as f64;
    assert!(bytes(&q8) < 0.3 * bytes(&of), "{} of {}", bytes(&q8), bytes(&of));
    let Some(int8) = Arithmetic::of(Precision::Int8, device().limits()) else { return };
    assert_refused(Network::of(&q8, &limits, int8), &["q8", "fp32, fp16 or bf16"]);
    assert!(Network::of(&pico_weights(), &limits, int8).is_ok());
}
